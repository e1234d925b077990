"""From a run folder to a bundle for the robot (``go1exp.deploy``)."""
