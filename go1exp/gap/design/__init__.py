"""The next recording: which motion tells apart what the recordings at hand cannot."""
