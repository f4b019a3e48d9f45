"""A proposal for many nearly standard normal coordinates, some tabulated, with linear and pairwise dependence.

Coordinates w (n, d); log densities are exact.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import special

from tvsbayes.inference.density import Proposal, Step
from tvsbayes.inference.tables import CUT_NODES, LEADER_NODES, NODES, Followers, Tables, between_cuts

HEAVY_DOF = 5.0
"""Degrees of freedom of all t distributions except that of the coupled coordinates."""
OWN_SHARE = 0.1
"""Share of draws of a tabulated coordinate from a t of its mean and sd: the table is a conditional, not a marginal."""
HEAVY_SHARE = 0.05
"""Share of draws from a multivariate t, which bounds the ratio target / proposal in the tails. In fifty dimensions a t
alone puts most draws off the target's typical set: effective draws fell to a third."""
COUPLED_SHARE, COUPLED_DOF, COUPLED_WIDTH = 0.2, 10.0, 1.2
"""Share of draws whose coupled coordinates come from a multivariate t, its degrees of freedom and factor on their sds.
Without them single draws of the paper's protocol had so much weight that 50 % more draws were needed."""
INFLATION = 1.03
"""Factor on the proposal's sds: under a narrower proposal single draws have large weights and walkers get stuck."""
SHARES = 0.6, 0.35
"""Shares of a chain's steps that draw all coordinates from the proposal, and some of them.

Where the proposal is too low, a walker stays for as many steps as its weight, and effective draws of the tails are
lost. New values of some coordinates move it."""
RENEWED_RANGE = 0.1, 0.6
"""Range of the uniform share of coordinates that a walker renews, where not all. It soon leaves a draw of large weight,
which is mostly due to a few coordinates."""
VARIANCE_RANGE = 0.8, 1.7
"""Limits of the variance of a normal coordinate, relative to the Laplace approximation's."""
TURN_RANGE = 0.4, 2.5
"""Limits of the precisions along principal axes by which one fit rotates normal coordinates; 1 is no rotation."""
LEAN_LIMIT = 0.5
"""Largest step of a tabulated coordinate, in its sds, for a step of one sd of another, by one fit."""
PAIR_T = 3.2
"""Coefficient over its standard error above which the product of two coordinates enters a regression: three of 2000
products of independent coordinates exceed it by chance."""
PAIR_SEARCHES = 3
"""Number of searches for products in the residuals of the regression: large ones hide small ones."""
PAIR_DRAWS = 16
"""Least number of draws for each product."""
TILT_LIMITS = 0.5, 0.2
"""Largest slope and curvature by which one fit changes a tabulated log density, per sd and its square."""
REACH = 4.0
"""Sds within which a fit's change of a table grows; beyond, it is constant."""
CORNER, INTERPLAY_LEAST, EDGES_MAX = 1.5, 1.0, 10
"""Corners, in w, at which the dependence of two coordinates is computed; the sum of interactions of the log density
above which one follows the other; the largest number of followers."""
MATTERS = 12.0
"""Draws whose log weight lies farther below the largest carry no information on the target's shape."""


def log_t(distance2: np.ndarray, dimension: int, dof: float = HEAVY_DOF) -> np.ndarray:
    """Compute the log density of a multivariate t of unit scale at squared distances."""
    constant = special.gammaln(0.5 * (dof + dimension)) - special.gammaln(0.5 * dof)
    constant -= 0.5 * dimension * np.log(dof * np.pi)
    return constant - 0.5 * (dof + dimension) * np.log1p(distance2 / dof)


def regression(x: np.ndarray, log_ratio: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Regress a log ratio of densities on coordinates and their squares, and significant products.

    Products are taken by forward selection on the residuals: all d (d - 1) / 2 would add more scatter than they
    explain.

    Args:
        x: coordinates in units of their sds, shape (n, d).
        log_ratio: shape (n,).

    Returns:
        Coefficients of the coordinates and of their squares, shape (d,) each, and of products, symmetric, zero where
        not taken, shape (d, d).
    """
    count, dimension = x.shape
    design = np.column_stack([np.ones(count), x, x**2])
    open_pairs = np.triu(np.ones((dimension, dimension), dtype=bool), 1)
    pairs = np.zeros((0, 2), dtype=int)
    spread = np.sqrt((x**2).T @ x**2)
    for search in range(PAIR_SEARCHES + 1):
        products = x[:, pairs[:, 0]] * x[:, pairs[:, 1]]
        whole = np.concatenate([design, products], axis=1)
        solution = np.linalg.lstsq(whole, log_ratio, rcond=None)[0]
        rest = log_ratio - whole @ solution
        t = np.where(open_pairs, np.abs((x * rest[:, None]).T @ x) / (spread * np.std(rest)), 0.0)
        new = np.argwhere(t > PAIR_T)
        room = count // PAIR_DRAWS - len(pairs)
        if search == PAIR_SEARCHES or not len(new) or room <= 0:
            break
        new = new[np.argsort(-t[tuple(new.T)])[:room]]
        open_pairs[tuple(new.T)] = False
        pairs = np.concatenate([pairs, new])
    _, slope, square, product = np.split(solution, [1, 1 + dimension, 1 + 2 * dimension])
    cross = np.zeros((dimension, dimension))
    cross[tuple(pairs.T)] = product
    return slope, square, cross + cross.T


@dataclass(frozen=True)
class Independence(Proposal):
    """An independence proposal: coordinates normal or tabulated, mixed with heavier-tailed parts.

    Parts of the mixture: every coordinate by itself; the coupled ones from a multivariate t; all from another t.

    Attributes:
        mean, sd: moments of every coordinate, shape (d,).
        places: tabulated coordinates, shape (h,).
        tables: their densities.
        coupled: places of the coupled coordinates, shape (c,).
        followers: tabulated coordinates that depend on another; their `tables` serve for means and sds alone.
        origin, turn: w = origin + turn v, shapes (d,) and (d, d). The coordinates v are independent; means, sds and
            tables are those of v.
    """

    mean: np.ndarray
    sd: np.ndarray
    places: np.ndarray
    tables: Tables
    coupled: np.ndarray
    followers: Followers
    origin: np.ndarray
    turn: np.ndarray

    def moved(self, mean: np.ndarray, sd: np.ndarray, tables: Tables, followers: Followers) -> Independence:
        """Return a copy with other means, sds and tables; moments of tabulated coordinates come from the tables."""
        mean, sd = mean.copy(), sd.copy()
        mean[self.places], sd[self.places] = tables.moments.value, tables.moments.sd
        sd[self.places] *= INFLATION
        return replace(self, mean=mean, sd=sd, tables=tables, followers=followers)

    def turned(self, cross: np.ndarray) -> Independence:
        """Return a copy with products of coordinates in its log density.

        Normal coordinates get the covariance of their products and depend linearly on tabulated ones; of two tabulated
        ones the later depends on the earlier.

        Args:
            cross: coefficients of products of (v - mean) / sd, symmetric, shape (d, d).
        """
        tabulated = np.isin(np.arange(len(self.mean)), self.places)
        plain = np.flatnonzero(~tabulated)
        values, vectors = np.linalg.eigh(np.eye(len(plain)) - cross[np.ix_(plain, plain)])
        covariance = (vectors / np.clip(values, *TURN_RANGE)) @ vectors.T
        step = np.eye(len(self.mean))
        step[np.ix_(plain, plain)] = np.linalg.cholesky(covariance)
        lean = np.eye(len(self.places))
        lean += np.clip(np.tril(cross[np.ix_(self.places, self.places)], -1), -LEAN_LIMIT, LEAN_LIMIT)
        step[np.ix_(self.places, self.places)] = lean
        step[np.ix_(plain, self.places)] = covariance @ cross[np.ix_(plain, self.places)] @ lean
        step *= self.sd[:, None] / self.sd
        return replace(self, origin=self.to_w(self.mean - step @ self.mean), turn=self.turn @ step)

    @cached_property
    def _back(self) -> np.ndarray:
        return np.linalg.inv(self.turn)

    @cached_property
    def _log_volume(self) -> float:
        """Compute ln |dw/dv|."""
        return float(np.linalg.slogdet(self.turn)[1])

    def to_v(self, w: np.ndarray) -> np.ndarray:
        """Map w (n, d) to v."""
        return (w - self.origin) @ self._back.T

    def to_w(self, v: np.ndarray) -> np.ndarray:
        """Map v (n, d) to w."""
        return self.origin + v @ self.turn.T

    def _each(self, v: np.ndarray) -> np.ndarray:
        """Compute the log density of each coordinate v, shape (n, d)."""
        distance2 = ((v - self.mean) / self.sd) ** 2
        log_density = -0.5 * np.log(2 * np.pi) - 0.5 * distance2 - np.log(self.sd)
        single = log_t(distance2[:, self.places], 1) - np.log(self.sd[self.places])
        table = self.tables.at(v[:, self.places])
        table[:, self.followers.follower] = self.followers.at(v[:, self.places])
        log_density[:, self.places] = np.logaddexp(np.log(1 - OWN_SHARE) + table, np.log(OWN_SHARE) + single)
        return log_density

    def log_density(self, w: np.ndarray) -> np.ndarray:
        """Compute the log density, shape (n,)."""
        v = self.to_v(w)
        each, log_sd, some = self._each(v), np.log(self.sd), self.coupled
        distance2 = ((v - self.mean) / self.sd) ** 2
        alone = np.sum(each, axis=1)
        partly = log_t(np.sum(distance2[:, some], axis=1) / COUPLED_WIDTH**2, len(some), COUPLED_DOF)
        partly += alone - np.sum(each[:, some], axis=1) - np.sum(log_sd[some] + np.log(COUPLED_WIDTH))
        whole = log_t(np.sum(distance2, axis=1), len(log_sd)) - np.sum(log_sd)
        shares = np.log([1 - COUPLED_SHARE - HEAVY_SHARE, COUPLED_SHARE, HEAVY_SHARE])
        return np.logaddexp.reduce(shares[:, None] + np.stack([alone, partly, whole]), axis=0) - self._log_volume

    def draw(self, count: int, generator: np.random.RandomState) -> np.ndarray:
        """Draw independent points, shape (count, d)."""
        per_place, one = (count, len(self.places)), (count, 1)
        normal = generator.standard_normal((count, len(self.mean)))
        single = np.sqrt(generator.chisquare(HEAVY_DOF, per_place) / HEAVY_DOF)
        partly = np.sqrt(generator.chisquare(COUPLED_DOF, one) / COUPLED_DOF) / COUPLED_WIDTH
        whole = np.sqrt(generator.chisquare(HEAVY_DOF, one) / HEAVY_DOF)
        share = generator.uniform(size=per_place)
        alone = generator.uniform(size=per_place) < OWN_SHARE
        chance = generator.uniform(size=one)
        chances = generator.uniform(size=(count, len(self.followers.leader)))
        every = np.ones(normal.shape, dtype=bool)
        v = self._one_by_one(every, normal, np.where(alone, single, np.nan), share, chances)
        some = np.isin(np.arange(len(self.mean)), self.coupled)
        v = np.where((chance < COUPLED_SHARE) & some, self.mean + self.sd * normal / partly, v)
        return self.to_w(np.where(chance > 1 - HEAVY_SHARE, self.mean + self.sd * normal / whole, v))

    def _one_by_one(
        self,
        new: np.ndarray,
        normal: np.ndarray,
        narrowed: np.ndarray,
        share: np.ndarray,
        chances: np.ndarray,
        before: np.ndarray | None = None,
    ) -> np.ndarray:
        """Map given random numbers to coordinates v, each by its own density.

        Args:
            new: coordinates to draw, shape (n, d); the others keep their values of `before`.
            normal: standard normal, shape (n, d).
            narrowed: divisor of a tabulated coordinate's normal number where its t is drawn, else NaN, shape (n, h).
            share: uniform numbers for the tables, shape (n, h).
            chances: uniform numbers for the followers, shape (n, f).
            before: present points, shape (n, d); None where all are drawn.
        """
        v = self.mean + self.sd * normal
        if before is not None:
            v = np.where(new, v, before)
        alone, stays = np.isfinite(narrowed), ~new[:, self.places]
        single = self.mean[self.places] + self.sd[self.places] * normal[:, self.places] / narrowed
        led = np.where(alone, single, self.tables.draw(share))
        led = np.where(stays, v[:, self.places], led)
        # A follower follows its leader, however that was drawn.
        v[:, self.places] = self.followers.drawn(led, share, chances, alone | stays)
        return v

    @property
    def steps(self) -> tuple[tuple[Step, float], ...]:
        """Return the moves of a chain with their shares."""
        return tuple(zip((self, self.renewed), SHARES, strict=True))

    def renewed(self, w: np.ndarray, generator: np.random.RandomState) -> tuple[np.ndarray, np.ndarray]:
        """Propose new values of some coordinates of every point, each from its own density, as a `density.Step`."""
        before, per_place = self.to_v(w), (len(w), len(self.places))
        new = generator.uniform(size=before.shape) < generator.uniform(*RENEWED_RANGE, size=(len(w), 1))
        normal = generator.standard_normal(before.shape)
        narrowed = np.sqrt(generator.chisquare(HEAVY_DOF, per_place) / HEAVY_DOF)
        narrowed = np.where(generator.uniform(size=per_place) < OWN_SHARE, narrowed, np.nan)
        share, chances = generator.uniform(size=per_place), generator.uniform(size=(len(w), len(self.followers.leader)))
        after = self._one_by_one(new, normal, narrowed, share, chances, before)
        return self.to_w(after), np.where(new, self._each(before) - self._each(after), 0.0).sum(axis=1)

    def fitted(self, w: np.ndarray, log_target: np.ndarray, log_weights: np.ndarray) -> Independence:
        """Fit the proposal as `Proposal.fitted` says; return it unchanged where too few draws have weight.

        Where the target differs from the proposal in means and covariance only, the log of their ratio is linear in v
        and the products of its coordinates. The coefficients give both and change the tables. A regression on the draws
        with weight scatters far less than weighted moments.
        """
        matters = np.isfinite(log_weights) & (log_weights > np.max(log_weights) - MATTERS)
        if matters.sum() <= 8 * len(self.mean):
            return self
        v = self.to_v(w[matters])
        near = np.clip((v - self.mean) / self.sd, -REACH, REACH)
        slope, square, cross = regression(near, log_target[matters] - self._each(v).sum(axis=1))
        variance = 1 / np.clip(1 - 2 * square, 0.6, 1.6)
        mean = self.mean + self.sd * np.clip(slope * variance, -1.0, 1.0)
        sd = INFLATION * np.sqrt(np.clip(self.sd**2 * variance, *VARIANCE_RANGE))
        at = np.clip((NODES - self.mean[self.places, None]) / self.sd[self.places, None], -REACH, REACH)
        tilt, bend = (
            np.clip(x[self.places, None], -limit, limit) for x, limit in zip((slope, square), TILT_LIMITS, strict=True)
        )
        change = tilt * at + bend * at**2
        of_followers = self.followers.tables.log_density + change[self.followers.follower][:, None]
        followers = replace(self.followers, tables=Tables.normalised(of_followers))
        straight = self.moved(mean, sd, Tables.normalised(self.tables.log_density + change), followers)
        return straight.turned(cross * np.sqrt(np.outer(variance, variance)))


def forest(target: Callable[[np.ndarray], np.ndarray], places: np.ndarray, dimension: int) -> list[tuple[int, int]]:
    """Choose the most dependent pairs of tabulated coordinates, as a forest, leaders before their followers.

    The interaction of two coordinates in the log density is computed at the corners of a square. The forest has the
    largest sum of interactions (as Chow and Liu, IEEE Trans. Inf. Theory 14 (1968) 462, choose a tree).

    Args:
        target: log density of points (n, d).
        places: tabulated coordinates, shape (h,).
        dimension: d.

    Returns:
        Rows of leader and follower among the tabulated coordinates.
    """
    count = len(places)
    first, second = np.triu_indices(count, 1)
    if not len(first):
        return []
    steps = CORNER * np.eye(dimension)[places]
    alone = target(np.concatenate([np.zeros((1, dimension)), steps, -steps]))
    centre, (ahead, behind) = alone[0], np.reshape(alone[1:], (2, count))
    strength = np.zeros(len(first))
    for one, side in ((1, ahead), (-1, behind)):
        for other, its in ((1, ahead), (-1, behind)):
            both = target(one * steps[first] + other * steps[second])
            with np.errstate(invalid="ignore"):
                beyond = both - side[first] - its[second] + centre
            strength += np.abs(np.where(np.isfinite(beyond), beyond, 0.0))
    tree = np.arange(count)
    edges: dict[int, list[int]] = {row: [] for row in range(count)}
    for edge in np.argsort(-strength)[:count]:
        a, b = int(first[edge]), int(second[edge])
        if strength[edge] < INTERPLAY_LEAST or sum(map(len, edges.values())) >= 2 * EDGES_MAX:
            break
        if tree[a] != tree[b]:
            tree[tree == tree[b]] = tree[a]
            edges[a].append(b)
            edges[b].append(a)
    pairs: list[tuple[int, int]] = []
    reached: set[int] = set()
    for root in sorted(edges, key=lambda row: -len(edges[row])):
        queue = [] if root in reached else [root]
        reached.add(root)
        for leader in queue:
            new = [row for row in edges[leader] if row not in reached]
            reached.update(new)
            queue.extend(new)
            pairs.extend((leader, row) for row in new)
    return pairs


def _at_each(target: Callable[[np.ndarray], np.ndarray], points: np.ndarray) -> np.ndarray:
    """Compute log densities of points (..., d), shape (...,)."""
    return (target(points.reshape(-1, points.shape[-1])) if points.size else np.zeros(0)).reshape(points.shape[:-1])


def _planes(target: Callable[[np.ndarray], np.ndarray], pairs: np.ndarray, dimension: int) -> np.ndarray:
    """Compute log densities on the planes of leaders and followers, shape (pairs, leader nodes, nodes).

    Of several followers of one leader, the later are evaluated with the earlier at their most probable values, so that
    two that explain the same misfit are not counted twice.

    Args:
        target: log density of points (n, d).
        pairs: coordinates of leader and follower, shape (pairs, 2).
        dimension: d.
    """
    turn = np.array([np.sum(pairs[:k, 0] == leader) for k, leader in enumerate(pairs[:, 0])], dtype=int)
    points = np.zeros((len(pairs), len(LEADER_NODES), len(CUT_NODES), dimension))
    planes = np.zeros((len(pairs), len(LEADER_NODES), len(NODES)))
    for now in range(turn.max(initial=-1) + 1):
        members = np.flatnonzero(turn == now)
        for k in members:
            leader, follower = pairs[k]
            points[k, :, :, leader], points[k, :, :, follower] = LEADER_NODES[:, None], CUT_NODES
        planes[members] = between_cuts(_at_each(target, points[members]))
        for k in members:
            best = NODES[np.argmax(np.nan_to_num(planes[k], nan=-np.inf), axis=1)]
            later = (pairs[:, 0] == pairs[k, 0]) & (turn > now)
            points[later, :, :, pairs[k, 1]] = best[:, None]
    return planes


def first_proposal(
    target: Callable[[np.ndarray], np.ndarray], dimension: int, heavy: np.ndarray, coupled: np.ndarray
) -> Independence:
    """Build a standard normal proposal, in which the density of each heavy coordinate is the target's along it.

    In w the other coordinates are centred and scaled by their conditional mean and width at a coordinate's value. A cut
    of the target through the mode is therefore the marginal density, up to the others' curvature. For the most
    dependent pairs (`forest`), a cut through the plane of both gives the density of the follower given the leader.

    Args:
        target: log density of points (n, d).
        dimension: d.
        heavy: coordinates to tabulate, shape (d,), boolean.
        coupled: coordinates of which a share is drawn together, shape (d,), boolean.
    """
    places = np.flatnonzero(heavy)
    pairs = forest(target, places, dimension)
    along = np.zeros((len(places), len(CUT_NODES), dimension))
    along[np.arange(len(places)), :, places] = CUT_NODES
    lines = between_cuts(_at_each(target, along))
    planes = _planes(target, places[np.reshape(np.array(pairs, dtype=int), (-1, 2))], dimension)
    rows, alone, gains = planes.copy(), lines.copy(), np.zeros_like(lines)
    for k in reversed(range(len(pairs))):
        leader, follower = pairs[k]
        # The joint density of both as the leader's marginal and the follower's conditional; the follower's includes its
        # own followers.
        rows[k] = np.where(np.isfinite(rows[k]), rows[k], -np.inf) + gains[follower]
        with np.errstate(invalid="ignore"):
            gain = special.logsumexp(rows[k], axis=1) - planes[k][:, NODES == 0.0][:, 0]
        gains[leader] += np.interp(NODES, LEADER_NODES, np.where(np.isfinite(gain), gain, 0.0))
        lines[follower] = special.logsumexp(rows[k], axis=0)
    leaders = np.setdiff1d(np.arange(len(places)), [follower for _, follower in pairs])
    lines[leaders] = alone[leaders] + gains[leaders]
    leader_rows, follower_rows = np.reshape(np.array(pairs, dtype=int), (-1, 2)).T
    followers = Followers(leader_rows, follower_rows, Tables.normalised(rows))
    tables = Tables.normalised(lines)
    mean, sd = np.zeros(dimension), np.full(dimension, INFLATION)
    together, zero = np.flatnonzero(coupled), np.zeros(dimension)
    first = Independence(mean, sd, places, tables, together, followers, zero, np.eye(dimension))
    return first.moved(mean, sd, tables, followers)
