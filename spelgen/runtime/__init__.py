"""What an emitted module computes with: plain torch, tested here, and copied into each module that uses it."""
