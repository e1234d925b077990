"""What knows no robot: errors, files, memory, signals, tensors, drawings."""
