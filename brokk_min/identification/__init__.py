"""From logs to nets: log files, excitation, fitting, validation."""
