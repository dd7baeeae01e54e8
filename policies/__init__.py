"""Training and export of skills, and the trained skills themselves (``<robot>/*.onnx`` with a card each)."""
