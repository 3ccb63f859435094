"""The sidecar YAML beside a URDF: settings that a URDF cannot express."""
