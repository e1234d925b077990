"""Tools on torch tensors that know neither robot nor task: memory, constants, randomness, delay lines, rotations."""
