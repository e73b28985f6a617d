"""The model beside ordinary methods of scikit-learn: same rows, same run, one table (`python -m studies.peers`).

The bodies and their data need no scikit-learn; other studies use them too.
"""

from importlib.util import find_spec

if find_spec("scipy") is not None:
    import scipy.linalg  # noqa: F401 - before gemuco loads numpy's BLAS, whose symbols would replace those of scipy's
