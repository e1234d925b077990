"""The next recording: which motion separates what the recordings at hand do not."""
