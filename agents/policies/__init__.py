"""Acting: files of agents, ONNX, callables, and the guard over them."""
