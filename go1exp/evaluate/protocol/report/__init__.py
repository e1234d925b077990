"""Reports of protocols and of comparisons: one HTML page each."""
