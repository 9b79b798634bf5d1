"""How networks are computed at inference: PyTorch, traced runtimes, torch.compile."""
