"""Whether there is something faster than this processor; training and structure determination ask, nothing else."""


def best() -> str | None:
    """The device of torch that they use: `cuda` if it can be, else None, and compiled code does it.

    To do without: CUDA_VISIBLE_DEVICES="" in the environment.
    """
    try:
        import torch
    except ImportError:
        return None
    return "cuda" if torch.cuda.is_available() else None
