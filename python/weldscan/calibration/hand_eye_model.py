"""The statistics of the hand-eye solve: linear in the unknowns, five variances that the shots themselves correct.

Unknown are a small rotation of X = flange_from_scanner about the scanner's axes, a translation along the flange's, and
the centres c_j in base: 15 numbers. Shot i gives r_ij = X m_ij - F_i^-1 c_j, nine numbers with the covariance

    V_i = f_s blockdiag(X Cov(m_ij) X^T) + f_t sigma_t^2 J_t J_t^T + f_r sigma_r^2 J_r J_r^T,

J_t and J_r moving all three by a small motion of the flange. Touched centres are a prior with the covariance
f_c sigma_c^2 I + f_b sigma_b^2 (ones x I). The sigmas are what was stated of sphere fits, robot and probe; the factors
f are 1 where that is right. Each has a log-normal prior, as wide as what was stated is doubtful. With X integrated out
(restricted likelihood) the shots correct them, and what they leave open of the factors is integrated out in turn: the
covariance is that of the posterior, and 95 % intervals from it are as wide as Student's where the shots are few.

Sources: H. D. Patterson and R. Thompson, Biometrika 58 (1971) 545 for the restricted likelihood; H. Rue, S. Martino,
N. Chopin, J. R. Statist. Soc. B 71 (2009) 319 for integrating variances out on a few nodes about their mode;
M. A. Woodbury for the inverse of V_i.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from weldscan.geometry import skew

Floats = NDArray[np.float64]

# The factors: sphere fits, the pose's place, the pose's direction, each touch's own error, the bias that all share.
SPHERE, PLACE, DIRECTION, TOUCH, BIAS = range(5)
# Within which factor each standard uncertainty is believed beforehand, two times out of three. A fit states a sphere's
# from its own residuals; robot and probe go by data sheets and rules of thumb.
BELIEVED = np.array([1.25, 2.0, 2.0, 2.0, 2.0])
FACTORS = len(BELIEVED)
# The same for the logarithm of a variance.
WIDTH = 2 * np.log(BELIEVED)
UNKNOWNS = 15
# Nodes over the factors: 256 give the covariance to a per cent.
NODES = 256
# Student's t for the nodes: heavier tails than any posterior here has.
NODE_DOF = 5.0
STENCIL = 0.05
NEWTON_STEPS = 30


@dataclass(frozen=True)
class Noise:
    """What is stated beforehand of robot and probe, k = 1."""

    pose_mm: float
    """Error of a flange pose's place, each axis."""
    pose_rad: float
    """And of its direction, about each axis."""
    touch_mm: float
    """Error of a touched centre of its own, each coordinate."""
    touch_bias_mm: float
    """Error that all touched centres share, each coordinate."""


@dataclass(frozen=True, eq=False)
class Posterior:
    """What the shots say of a small step of the unknowns, and of the noise."""

    step: Floats
    """(15,) rotation (rad), translation, three centres (mm)."""
    covariance: Floats
    """(15, 15)"""
    factors: Floats
    """(5,) variances over the stated ones, posterior means."""
    mode: Floats
    """(5,) the factors where the posterior is highest."""


class Linear:
    """The problem about one point: all that does not depend on the factors is computed once.

    Args:
        x: (4, 4), flange_from_scanner there.
        centres: (3, 3), base.
        flange_from_base: (n, 4, 4).
        seen: (n, 3, 3), scanner frame.
        seen_cov: (n, 3, 3, 3).
        touched: (3, 3) touched centres, or None where nothing is known of them.
        noise: the stated one.
    """

    def __init__(
        self,
        x: Floats,
        centres: Floats,
        flange_from_base: Floats,
        seen: Floats,
        seen_cov: Floats,
        touched: Floats | None,
        noise: Noise,
    ) -> None:
        n, rotation, turn = len(seen), x[:3, :3], flange_from_base[:, :3, :3]
        expected = np.einsum("nab,jb->nja", turn, centres) + flange_from_base[:, None, :3, 3]
        self.shots, self.touched, self.noise = n, touched, noise
        self.residuals: Floats = np.asarray(seen @ rotation.T + x[:3, 3] - expected)
        rows = np.zeros((n, 3, 3, UNKNOWNS + 1))
        rows[..., :3] = -rotation @ skew(seen)
        rows[..., 3:6] = np.eye(3)
        for j in range(3):
            rows[:, j, :, 6 + 3 * j : 9 + 3 * j] = -turn
        rows[..., UNKNOWNS] = self.residuals
        moves = np.zeros((n, 3, 3, 6))
        moves[..., :3] = np.eye(3) * noise.pose_mm
        moves[..., 3:] = skew(expected) * noise.pose_rad
        sphere = rotation @ seen_cov @ rotation.T
        precise = np.linalg.inv(sphere)
        self.rows, self.moves, self.sphere = rows.reshape(n, 9, -1), moves.reshape(n, 9, 6), sphere
        self._log_sphere: Floats = np.linalg.slogdet(sphere)[1].sum(axis=1)
        weighted = (precise @ rows).reshape(n, 9, -1)
        moved = (precise @ moves).reshape(n, 9, 6)
        self._rows_rows: Floats = np.swapaxes(self.rows, 1, 2) @ weighted
        self._moves_rows: Floats = np.swapaxes(self.moves, 1, 2) @ weighted
        self._moves_moves: Floats = np.swapaxes(self.moves, 1, 2) @ moved
        self._off = np.zeros((9, UNKNOWNS + 1))
        self._off[:, 6:UNKNOWNS] = np.eye(9)
        if touched is not None:
            self._off[:, UNKNOWNS] = (centres - touched).reshape(-1)

    def covariance(self, factors: Floats) -> Floats:
        """V_i of every shot, (n, 9, 9)."""
        sphere = np.zeros((self.shots, 9, 9))
        for j in range(3):
            sphere[:, 3 * j : 3 * j + 3, 3 * j : 3 * j + 3] = factors[SPHERE] * self.sphere[:, j]
        spread = np.repeat(factors[[PLACE, DIRECTION]], 3)
        return np.asarray(sphere + (self.moves * spread) @ np.swapaxes(self.moves, 1, 2))

    def grams(self, factors: Floats, weights: Floats | None = None) -> tuple[Floats, Floats]:
        """Per node and shot rows^T V^-1 rows and log det V: (k, n, 16, 16) and (k, n); `factors` (k, 5)."""
        spread = np.repeat(factors[:, None, [PLACE, DIRECTION]], 3, axis=2)
        if weights is not None:
            spread = spread / weights[:, None]
        spread = np.broadcast_to(spread, (len(factors), self.shots, 6))
        scale = factors[:, SPHERE, None]
        inner = self._moves_moves + (scale[..., None] / spread)[..., None] * np.eye(6)
        grams = self._rows_rows - np.swapaxes(self._moves_rows, 1, 2) @ np.linalg.solve(
            inner, np.broadcast_to(self._moves_rows, (*inner.shape[:2], 6, UNKNOWNS + 1))
        )
        log_det = self._log_sphere + 9 * np.log(scale) + np.linalg.slogdet(inner)[1]
        return grams / scale[..., None, None], log_det + np.log(spread / scale[..., None]).sum(axis=-1)

    def prior(self, factors: Floats) -> tuple[Floats, Floats]:
        """The same for the touched centres: (k, 16, 16) and (k,)."""
        if self.touched is None:
            return np.zeros((len(factors), UNKNOWNS + 1, UNKNOWNS + 1)), np.zeros(len(factors))
        own, shared = factors[:, TOUCH] * self.noise.touch_mm**2, factors[:, BIAS] * self.noise.touch_bias_mm**2
        common = np.kron(np.ones((3, 3)), np.eye(3))
        precise = (np.eye(9) - (shared / (own + 3 * shared))[:, None, None] * common) / own[:, None, None]
        return self._off.T @ precise @ self._off, 3 * (2 * np.log(own) + np.log(own + 3 * shared))

    def solve(
        self, factors: Floats, keep: Floats | None = None, weights: Floats | None = None
    ) -> tuple[Floats, Floats, Floats, Floats]:
        """Per node: step (k, 15), covariance (k, 15, 15), chi square (k,), -2 log restricted likelihood (k,).

        `keep` (n,) of ones and zeros says which shots count, `weights` (n,) by how much a pose is better than others.
        """
        grams, log_det = self.grams(factors, weights)
        count = np.ones(self.shots) if keep is None else keep
        gram, prior_log_det = self.prior(factors)
        gram = gram + np.einsum("knab,n->kab", grams, count)
        normal, right = gram[:, :UNKNOWNS, :UNKNOWNS], gram[:, :UNKNOWNS, UNKNOWNS]
        covariance = np.linalg.inv(normal)
        step = -np.einsum("kab,kb->ka", covariance, right)
        chi2 = gram[:, UNKNOWNS, UNKNOWNS] + np.einsum("ka,ka->k", right, step)
        minus_2_log = chi2 + log_det @ count + prior_log_det + np.linalg.slogdet(normal)[1]
        return step, covariance, chi2, minus_2_log

    def cost(self, logs: Floats, keep: Floats | None = None, weights: Floats | None = None) -> Floats:
        """-2 log posterior of the factors, (k,); `logs` (k, 5) are their logarithms."""
        likelihood = self.solve(np.exp(logs), keep, weights)[3]
        return np.asarray(likelihood + np.square(logs / WIDTH).sum(axis=1))

    def mode(
        self,
        start: Floats | None = None,
        keep: Floats | None = None,
        weights: Floats | None = None,
        steps: int = NEWTON_STEPS,
    ) -> tuple[Floats, Floats]:
        """The logarithms of the factors where their posterior is highest, and the Hessian of `cost` there: Newton."""
        at = np.zeros(FACTORS) if start is None else start
        offsets, pairs = _stencil()
        for _ in range(steps):
            values = self.cost(at + STENCIL * offsets, keep, weights)
            plus, minus = values[1 : 1 + FACTORS], values[1 + FACTORS : 1 + 2 * FACTORS]
            gradient = (plus - minus) / (2 * STENCIL)
            hessian = np.diag((plus + minus - 2 * values[0]) / STENCIL**2)
            for (a, b), value in zip(pairs, values[1 + 2 * FACTORS :], strict=True):
                mixed = (value - plus[a] - plus[b] + values[0]) / STENCIL**2
                hessian[a, b] = hessian[b, a] = mixed
            curvature, axes = np.linalg.eigh(hessian)
            # A factor that the shots say nothing about has its prior's curvature, and none much less.
            curvature = np.maximum(np.abs(curvature), 1 / np.square(WIDTH).max())
            step = -axes @ ((axes.T @ gradient) / curvature)
            step *= min(1.0, 2.0 / max(float(np.linalg.norm(step)), 1e-12))
            tries = np.array([1.0, 0.5, 0.2, 0.05])
            costs = self.cost(at + tries[:, None] * step, keep, weights)
            best = int(np.argmin(costs))
            if costs[best] >= values[0] or np.abs(step).max() < 1e-3:
                break
            at = at + tries[best] * step
        return at, np.asarray((axes * curvature) @ axes.T)

    def posterior(self, keep: Floats | None = None, start: Floats | None = None) -> Posterior:
        """The unknowns with the factors integrated out."""
        mode, hessian = self.mode(start, keep)
        # Half the cost is -log posterior, so that its curvature is half the Hessian.
        spread = np.linalg.cholesky(np.linalg.inv(hessian / 2))
        nodes, density = _nodes()
        logs = mode + nodes @ spread.T
        factors = np.exp(logs)
        step, covariance, _, likelihood = self.solve(factors, keep)
        cost = likelihood + np.square(logs / WIDTH).sum(axis=1)
        weight = np.exp(-(cost - cost.min()) / 2) / density
        weight /= weight.sum()
        mean = weight @ step
        off = step - mean
        return Posterior(
            step=mean,
            covariance=np.asarray(np.einsum("k,kab->ab", weight, covariance) + (off * weight[:, None]).T @ off),
            factors=weight @ factors,
            mode=np.exp(mode),
        )


def _stencil() -> tuple[Floats, list[tuple[int, int]]]:
    """Offsets for gradient and Hessian by differences: centre, forward, backward, and forward in pairs."""
    unit = np.eye(FACTORS)
    pairs = [(a, b) for a in range(FACTORS) for b in range(a)]
    return np.vstack([np.zeros((1, FACTORS)), unit, -unit, [unit[a] + unit[b] for a, b in pairs]]), pairs


def _nodes() -> tuple[Floats, Floats]:
    """Nodes spread like a five-dimensional Student's t, (k, 5), and its density there but for a factor, (k,)."""
    global _KEPT  # noqa: PLW0603 - made once
    if _KEPT is None:
        # M. Roberts' sequence: multiples of the powers of the generalised golden section for six numbers.
        golden = 1.1127756842787053
        uniform = (0.5 + np.arange(1, NODES + 1)[:, None] * golden ** -np.arange(1.0, 7.0)) % 1.0
        normal = np.vectorize(NormalDist().inv_cdf)(uniform)
        # Chi-square by Wilson and Hilferty.
        chi2 = NODE_DOF * (1 - 2 / (9 * NODE_DOF) + normal[:, FACTORS] * math.sqrt(2 / (9 * NODE_DOF))) ** 3
        nodes = normal[:, :FACTORS] / np.sqrt(np.maximum(chi2, 1e-3) / NODE_DOF)[:, None]
        _KEPT = nodes, (1 + np.square(nodes).sum(axis=1) / NODE_DOF) ** (-(NODE_DOF + FACTORS) / 2)
    return _KEPT


_KEPT: tuple[Floats, Floats] | None = None


def chi2_quantile(probability: float, dof: float) -> float:
    """The value that chi-square stays below with a probability (Wilson and Hilferty 1931: to a per cent)."""
    z = NormalDist().inv_cdf(probability)
    return float(dof * (1 - 2 / (9 * dof) + z * math.sqrt(2 / (9 * dof))) ** 3)


def f_exceeded(value: float, dof: float, dof_below: float) -> float:
    """The probability that F exceeds a value (E. Paulson, Ann. Math. Statist. 13 (1942) 233)."""
    root = max(value, 0.0) ** (1 / 3)
    a, b = 2 / (9 * dof), 2 / (9 * dof_below)
    z = ((1 - b) * root - (1 - a)) / math.sqrt(b * root**2 + a)
    return float(0.5 * math.erfc(z / math.sqrt(2)))
