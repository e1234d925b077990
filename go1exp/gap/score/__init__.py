"""How well the model explains windows of data, and where it does not."""
