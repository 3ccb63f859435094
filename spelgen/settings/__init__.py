"""What a URDF does not say about a robot: the sidecar YAML beside it, checked key by key."""
