"""What runs a trained network: torch, OpenVINO or ONNX Runtime, each behind the same `Network`."""
