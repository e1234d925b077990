"""The model run through windows of recordings, many variants side by side."""
