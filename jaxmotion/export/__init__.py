"""What leaves Python: functions as ONNX and StableHLO, motions as glTF."""
