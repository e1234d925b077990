"""Which effects explain what the model cannot."""
