"""Inference backends for trained networks: torch, OpenVINO and ONNX Runtime, each behind the same `Network`."""
