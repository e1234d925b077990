"""``go1exp report``: training runs together, from what their run folders hold and nothing else."""
