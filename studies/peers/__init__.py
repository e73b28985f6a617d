"""The model beside ordinary methods of scikit-learn: same rows, same run, one table (`python -m studies.peers`)."""

import scipy.linalg  # noqa: F401 - before gemuco loads the BLAS of numpy, whose symbols would replace those of scipy's
