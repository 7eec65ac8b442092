"""A page to play in without a server: the model as ONNX, with recorded episodes."""
