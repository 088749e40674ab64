"""The network of the paper, as inference needs it (torch, float32)."""
