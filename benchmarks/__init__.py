"""Speed, each script one JSON; run as `python -m benchmarks.<name>` from the project's root."""
