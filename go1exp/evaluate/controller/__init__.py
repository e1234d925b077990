"""Controllers other than a policy: command and estimated state in, targets, gains and torques out."""
