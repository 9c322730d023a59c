"""Tasks to learn and plan on: functional environments, and their Gymnasium versions."""
