"""Functions that leave Python: as ONNX, as StableHLO, and what plays them."""
