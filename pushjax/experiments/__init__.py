"""The experiments, one module each; a module with an underscore is shared."""
