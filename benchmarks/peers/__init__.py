"""Other programs that solve the same problems, each at its best settings."""
