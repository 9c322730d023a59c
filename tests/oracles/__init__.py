"""Independent implementations that give the same answers, to compare with in tests."""
