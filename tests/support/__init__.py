"""Programs and problems that many tests share."""
