"""The runtime on the robot. It imports NumPy, onnxruntime and the standard library; no torch, engine or Hydra."""
