"""Other programs that answer the same question, at their best settings."""
