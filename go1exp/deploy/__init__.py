"""What runs on the robot: NumPy, onnxruntime and the standard library; no torch, no engine, no Hydra, no pydantic."""
