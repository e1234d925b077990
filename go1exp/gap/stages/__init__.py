"""The stages of ``go1exp gap``, one file each."""
