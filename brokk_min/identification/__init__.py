"""From logs to nets: log files, inspection, our fit, validation."""
