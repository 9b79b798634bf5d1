"""Engines that compute networks at inference: PyTorch, traced runtimes, torch.compile."""
