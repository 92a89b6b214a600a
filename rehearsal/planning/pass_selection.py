"""Which of the tried passes make the best sweep together: the score of any set of passes follows from what each has shown alone.

Coverage is that of their union, and the means are over all of their poses.
"""

from collections.abc import Sequence

import numpy as np

from rehearsal.planning.pass_kinds import MOST_PASSES
from rehearsal.planning.sweep_score import MEANS, WORDING, TriedPass

# About the way of the probe from one pass to the next [mm].
TRANSFER_MM = 30.0
# Beginnings of the search for the best set.
BEGINNINGS = 12


def scores_with(pool: Sequence[TriedPass], others: Sequence[TriedPass]) -> np.ndarray:
    """The score (k,) of each pass of a pool, together with other passes."""
    weight = {name: points for name, (points, *_) in WORDING.items()}
    seen = np.stack([each.seen for each in pool])
    if others:
        seen = seen | np.any([each.seen for each in others], axis=0)
    sums = np.stack([each.sums for each in pool]) + sum(each.sums for each in others)
    poses = np.array([each.poses for each in pool]) + sum(each.poses for each in others)
    path_mm = np.array([each.path_mm for each in pool]) + sum(each.path_mm + TRANSFER_MM for each in others)
    means = sums / poses[:, None] @ [weight[name] for name in MEANS]
    return weight["seen"] * seen.mean(axis=1) + means + weight["path_mm"] * path_mm


def score_of(passes: Sequence[TriedPass]) -> float:
    """The score of passes together; minus infinity without one."""
    return float(scores_with(passes[:1], passes[1:])[0]) if passes else -np.inf


def best_selection(pool: Sequence[TriedPass]) -> list[TriedPass]:
    """Passes of a pool that have the best score together: by adding, exchanging and removing passes while that makes it better."""
    if not pool:
        return []
    begins = np.argsort(-scores_with(pool, []), kind="stable")[:BEGINNINGS]
    return max((_improved([pool[begin]], pool) for begin in begins), key=score_of)


def _improved(chosen: list[TriedPass], pool: Sequence[TriedPass]) -> list[TriedPass]:
    """The chosen passes after all changes of one pass that make their score better."""
    least, number_of = score_of(chosen), {id(each): number for number, each in enumerate(pool)}
    while True:
        best, changed = least, chosen
        kept = [chosen[:number] + chosen[number + 1 :] for number in range(len(chosen))]
        for others in [chosen, *kept] if len(chosen) < MOST_PASSES else kept:
            scores = scores_with(pool, others)
            scores[[number_of[id(each)] for each in others]] = -np.inf
            if scores.max() > best:
                best, changed = float(scores.max()), [*others, pool[int(scores.argmax())]]
            if score_of(others) > best:
                best, changed = score_of(others), others
        if best <= least + 1e-9:
            return chosen
        least, chosen = best, changed
