"""Ordinary regressions and imputers of scikit-learn, with the care that a user would take.

Inputs are in standard deviations of the training rows. Settings are chosen by blocks of time (or episodes) that are
held out of the training rows; the test rows are never used. With several conditions, ridge, cubic ridge, the Gaussian
process and the imputers are fitted for each condition, and the trees get the condition one-hot.
"""

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations_with_replacement

import numpy as np
from scipy.optimize import minimize
from sklearn.ensemble import ExtraTreesRegressor, HistGradientBoostingRegressor
from sklearn.exceptions import ConvergenceWarning
from sklearn.experimental import enable_iterative_imputer  # noqa: F401
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, Kernel, WhiteKernel
from sklearn.impute import IterativeImputer, KNNImputer

VERSION = 2
"""Number of this version of the peers; results of another version are not taken from the cache."""
ALPHAS = np.geomspace(1e-10, 1e3, 27)
"""Candidates of ridge's weight, per training row."""
FEATURES = 2500
"""With more polynomial features than this the degree is lowered."""
GP_ROWS, GP_SEARCH_ROWS = 1500, 300
"""Largest numbers of rows of a Gaussian process, and of the search for its kernel."""
GP_STEPS = 80
GP_STARTS = ((1.0, 1e-2), (3.0, 1e-1), (0.5, 1e-3))
"""Starts of the search: length per root of the number of inputs, and variance of the noise."""
GP_NOISE = -1.3
"""A logarithmic likelihood per row below this is hardly better than that of pure noise, -1.42."""
IMPUTER_ROWS = 5000
"""Largest number of rows that an imputer keeps."""
TREES, BOOSTS = 200, 400
HELD_OUT = 0.2
"""Share of the blocks that chooses a setting."""


@dataclass(frozen=True, slots=True)
class Problem:
    """Rows to learn from and rows to predict.

    Attributes:
        x: Given values, shape (n, d).
        y: Values to predict, shape (n, k).
        others: Values that are known in training only, shape (n, e).
        condition: Index of the condition of every row, shape (n,).
        block: Index of the block of time of every row, shape (n,).
        query: Given values of the rows to predict, shape (m, d).
        query_condition: Their conditions, shape (m,).
        seed: Seed of the method's chance.
    """

    x: np.ndarray
    y: np.ndarray
    others: np.ndarray
    condition: np.ndarray
    block: np.ndarray
    query: np.ndarray
    query_condition: np.ndarray
    seed: int

    def held_out(self) -> np.ndarray:
        """Choose the rows of a fifth of the blocks, booleans, shape (n,)."""
        blocks = np.unique(self.block)
        count = max(1, round(HELD_OUT * len(blocks)))
        return np.isin(self.block, np.random.default_rng(self.seed).permutation(blocks)[:count])

    def subset(self, rows: np.ndarray) -> "Problem":
        """Return the problem with some training rows."""
        parts = {name: getattr(self, name)[rows] for name in ("x", "y", "others", "condition", "block")}
        return replace(self, **parts)

    def at_most(self, count: int) -> "Problem":
        """Return the problem with at most this number of random training rows."""
        if len(self.x) <= count:
            return self
        return self.subset(np.sort(np.random.default_rng(self.seed).permutation(len(self.x))[:count]))


Method = Callable[[Problem], np.ndarray]
"""A method returns its predictions, shape (m, k)."""


def scales(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and standard deviation of every column, 1 where it never varies."""
    mean, std = values.mean(axis=0), values.std(axis=0)
    return mean, np.where(std > 1e-9 * np.maximum(1.0, np.abs(mean)), std, 1.0)


def by_condition(method: Method, problem: Problem) -> np.ndarray:
    """Fit a method for each condition, in standard deviations of its rows."""
    prediction = np.full((len(problem.query), problem.y.shape[1]), np.nan)
    for index in np.unique(problem.query_condition):
        mine = problem.query_condition == index
        part = problem.subset(problem.condition == index)
        part = replace(part, query=problem.query[mine], query_condition=problem.query_condition[mine])
        prediction[mine] = _scaled(method, part)
    return prediction


def one_hot(method: Method, problem: Problem) -> np.ndarray:
    """Fit a method once, with the condition as inputs of 0 and 1."""
    conditions = np.unique(problem.condition)
    if len(conditions) == 1:
        return _scaled(method, problem)
    x, query = (
        np.column_stack([values, (owner[:, None] == conditions).astype(float)])
        for values, owner in ((problem.x, problem.condition), (problem.query, problem.query_condition))
    )
    return _scaled(method, replace(problem, x=x, query=query))


def _scaled(method: Method, problem: Problem) -> np.ndarray:
    (mx, sx), (my, sy), (mo, so) = scales(problem.x), scales(problem.y), scales(problem.others)
    normal = replace(
        problem,
        x=(problem.x - mx) / sx,
        y=(problem.y - my) / sy,
        others=(problem.others - mo) / so,
        query=(problem.query - mx) / sx,
    )
    return np.asarray(method(normal) * sy + my)


def polynomial(x: np.ndarray, degree: int) -> np.ndarray:
    """Return all products of up to `degree` columns, shape (n, features), the constant left out."""
    columns = [x]
    for order in range(2, degree + 1):
        chosen = np.array(list(combinations_with_replacement(range(x.shape[1]), order)))
        columns.append(np.prod(x[:, chosen], axis=2))
    return np.concatenate(columns, axis=1)


def ridge(problem: Problem, degree: int = 1) -> np.ndarray:
    """Fit ridge regression on products of the inputs; its weight is chosen by held-out blocks."""
    while degree > 1 and _size(problem.x.shape[1], degree) > FEATURES:
        degree -= 1
    x, query = polynomial(problem.x, degree), polynomial(problem.query, degree)
    mean, std = scales(x)
    x, query = (x - mean) / std, (query - mean) / std
    held = problem.held_out()
    if 0 < held.sum() < len(held):
        tried = solve(x[~held], problem.y[~held], ALPHAS)
        misses = [np.mean((x[held] @ weights + offset - problem.y[held]) ** 2) for weights, offset in tried]
        alpha = ALPHAS[int(np.argmin(misses))]
    else:
        alpha = 1e-3
    ((weights, offset),) = solve(x, problem.y, np.array([alpha]))
    return np.asarray(query @ weights + offset)


def _size(inputs: int, degree: int) -> int:
    """Return the number of products of up to `degree` of the inputs."""
    return int(np.prod([inputs + k for k in range(1, degree + 1)]) // np.prod(range(1, degree + 1))) - 1


def solve(x: np.ndarray, y: np.ndarray, alphas: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return weights, shape (d, k), and offset, shape (k,), for every alpha."""
    centre, offset = x.mean(axis=0), y.mean(axis=0)
    x, y = x - centre, y - offset
    if len(x) < x.shape[1]:
        left, values, right = np.linalg.svd(x, full_matrices=False)
        squares, turned, back = values**2, values[:, None] * (left.T @ y), right.T
    else:
        squares, back = np.linalg.eigh(x.T @ x)
        squares, turned = np.maximum(squares, 0.0), back.T @ (x.T @ y)
    weights = [back @ (turned / (squares + len(x) * alpha)[:, None]) for alpha in alphas]
    return [(matrix, offset - centre @ matrix) for matrix in weights]


def gaussian_process(problem: Problem) -> np.ndarray:
    """Fit a Gaussian process per element: radial kernel with a length per input, and noise."""
    rows, search = problem.at_most(GP_ROWS), problem.at_most(GP_SEARCH_ROWS)
    prediction = np.empty((len(problem.query), problem.y.shape[1]))
    for k in range(problem.y.shape[1]):
        kernel = _best_kernel(search.x, search.y[:, k])
        model = GaussianProcessRegressor(kernel, optimizer=None).fit(rows.x, rows.y[:, k])
        prediction[:, k] = model.predict(problem.query)
    return prediction


def _best_kernel(x: np.ndarray, y: np.ndarray) -> Kernel:
    """Search from one start, and from others if it ends where the kernel explains nothing: all is noise."""
    best: tuple[float, Kernel] | None = None
    for length, noise in GP_STARTS:
        lengths = RBF(np.full(x.shape[1], length * np.sqrt(x.shape[1])), (1e-2, 1e5))
        model = _search(ConstantKernel(1.0, (1e-3, 1e6)) * lengths + WhiteKernel(noise), x, y)
        likelihood = model.log_marginal_likelihood_value_
        if best is None or likelihood > best[0]:
            best = likelihood, model.kernel_
        if best[0] > GP_NOISE * len(y):
            break
    assert best is not None
    return best[1]


def _search(kernel: Kernel, x: np.ndarray, y: np.ndarray) -> GaussianProcessRegressor:
    """Maximise the likelihood of a kernel by at most `GP_STEPS` steps of L-BFGS-B."""

    def descend(
        loss: Callable[[np.ndarray], tuple[float, np.ndarray]], start: np.ndarray, bounds: np.ndarray
    ) -> tuple[np.ndarray, float]:
        end = minimize(loss, start, method="L-BFGS-B", jac=True, bounds=bounds, options={"maxiter": GP_STEPS})
        return end.x, end.fun

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # a length at its bound: an input without effect
        return GaussianProcessRegressor(kernel, optimizer=descend).fit(x, y)


def boosted_trees(problem: Problem) -> np.ndarray:
    """Fit histogram gradient boosting per element; held-out blocks choose the number of trees."""
    held = problem.held_out()
    prediction = np.empty((len(problem.query), problem.y.shape[1]))
    for k in range(problem.y.shape[1]):
        y = problem.y[:, k]
        trial = _boosting(BOOSTS, problem.seed).fit(problem.x[~held], y[~held])
        misses = [np.mean((p - y[held]) ** 2) for p in trial.staged_predict(problem.x[held])]
        model = _boosting(int(np.argmin(misses)) + 1, problem.seed).fit(problem.x, y)
        prediction[:, k] = model.predict(problem.query)
    return prediction


def _boosting(count: int, seed: int) -> HistGradientBoostingRegressor:
    return HistGradientBoostingRegressor(max_iter=count, early_stopping=False, random_state=seed)


def extra_trees(problem: Problem) -> np.ndarray:
    """Fit extremely randomised trees; held-out blocks choose the smallest leaf."""
    held, y = problem.held_out(), problem.y if problem.y.shape[1] > 1 else problem.y[:, 0]

    def miss(leaf: int) -> float:
        model = ExtraTreesRegressor(TREES // 4, min_samples_leaf=leaf, random_state=problem.seed)
        return float(np.mean((model.fit(problem.x[~held], y[~held]).predict(problem.x[held]) - y[held]) ** 2))

    model = ExtraTreesRegressor(TREES, min_samples_leaf=min((1, 3, 10), key=miss), random_state=problem.seed)
    return np.asarray(model.fit(problem.x, y).predict(problem.query)).reshape(len(problem.query), -1)


def iterative_imputer(problem: Problem) -> np.ndarray:
    """Fill the missing signals by rounds of Bayesian ridge regressions."""
    rows = problem.at_most(IMPUTER_ROWS)
    known = np.concatenate([rows.x, rows.y, rows.others], axis=1)
    query = np.full((len(problem.query), known.shape[1]), np.nan)
    query[:, : problem.x.shape[1]] = problem.query
    varies = known.std(axis=0) > 0.0
    if not varies[problem.x.shape[1] :].any():
        return np.zeros((len(query), problem.y.shape[1]))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        imputer = IterativeImputer(random_state=problem.seed, keep_empty_features=True).fit(known)
        filled = imputer.transform(query)
    return np.asarray(filled[:, problem.x.shape[1] :][:, : problem.y.shape[1]])


def knn_imputer(problem: Problem) -> np.ndarray:
    """Fill the missing signal by the nearest rows; held-out blocks choose their number."""
    rows = problem.at_most(IMPUTER_ROWS)
    held = rows.held_out()
    size = rows.x.shape[1]

    def fill(count: int, known: np.ndarray, query: np.ndarray) -> np.ndarray:
        asked = np.full((len(query), known.shape[1]), np.nan)
        asked[:, :size] = query
        imputer = KNNImputer(n_neighbors=count, weights="distance").fit(known)
        return np.asarray(imputer.transform(asked)[:, size:])

    known = np.concatenate([rows.x, rows.y], axis=1)
    trial = np.flatnonzero(held)[:: max(1, held.sum() // 300)]
    miss = lambda count: float(np.mean((fill(count, known[~held], rows.x[trial]) - rows.y[trial]) ** 2))
    return fill(min((3, 10, 30), key=miss), known, problem.query)


METHODS: dict[str, Method] = {
    "ridge": partial(by_condition, ridge),
    "cubic_ridge": partial(by_condition, partial(ridge, degree=3)),
    "gaussian_process": partial(by_condition, gaussian_process),
    "boosted_trees": partial(one_hot, boosted_trees),
    "extra_trees": partial(one_hot, extra_trees),
    "iterative_imputer": partial(by_condition, iterative_imputer),
    "knn_imputer": partial(by_condition, knn_imputer),
}


def answer(name: str, arrays: tuple[np.ndarray, ...], seed: int, version: int = VERSION) -> np.ndarray:
    """Return the predictions of a peer, shape (m, k); the arguments are the key of the cache.

    Args:
        name: Key of `METHODS`.
        arrays: The arrays of `Problem` in its order.
        seed: Seed of the method's chance.
        version: Number of the version of the peers.
    """
    x, y, others, condition, block, query, query_condition = arrays
    return METHODS[name](Problem(x, y, others, condition, block, query, query_condition, seed))
