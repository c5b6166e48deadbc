"""Inference backends for trained networks: torch and OpenVINO, each behind the same `Network`."""
