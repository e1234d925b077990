"""The simulated robot in the laboratory: driven through a motion while a logger like a real one's listens."""
