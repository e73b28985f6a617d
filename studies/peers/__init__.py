"""The model beside ordinary methods of scikit-learn: same rows, same run, one table (`python -m studies.peers`)."""

try:
    import scipy.linalg  # noqa: F401 - before gemuco loads numpy's BLAS, whose symbols would replace those of scipy's
    import sklearn  # noqa: F401
except ImportError as error:
    text = f"The peers need scikit-learn ({error}). Run `make peers`, or install the extra `peers`."
    raise ImportError(text) from None
