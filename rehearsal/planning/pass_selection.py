"""Which of the tried passes make the best sweep together: the score of any set of passes follows from what
each has shown alone.

Coverage is that of their union, and the means are over all of their poses.
"""

from collections.abc import Sequence

import numpy as np

from rehearsal.planning.sweep_score import MEANS, WORDING, TriedPass

# About the way of the probe from one pass to the next [mm].
TRANSFER_MM = 30.0
# Beginnings of the search for the best set.
BEGINNINGS = 12


class PassPool:
    """Tried passes as arrays, so that sets of them have their scores at once; a set is a list of their
    numbers.
    """

    def __init__(self, passes: Sequence[TriedPass]) -> None:
        weight = {name: points for name, (points, *_) in WORDING.items()}
        self._seen = np.stack([one.seen for one in passes]).astype(np.float32)
        self._means = np.stack([one.sums for one in passes]) @ [weight[name] for name in MEANS]
        self._poses = np.array([one.poses for one in passes])
        self._path = weight["path_mm"] * np.array([one.path_mm for one in passes])
        self._seen_points, self._transfer = (
            weight["seen"] / self._seen.shape[1],
            weight["path_mm"] * TRANSFER_MM,
        )

    def scores_with(self, chosen: list[int]) -> np.ndarray:
        """The score (k,) of a set of passes, together with each other one; minus infinity for those of the
        set.
        """
        unseen = 1.0 - self._seen[chosen].max(axis=0, initial=0.0)
        seen = self._seen @ unseen + (len(unseen) - unseen.sum())
        means = (self._means + self._means[chosen].sum()) / (self._poses + self._poses[chosen].sum())
        path = self._path + self._path[chosen].sum() + len(chosen) * self._transfer
        scores = self._seen_points * seen + means + path
        scores[chosen] = -np.inf
        return scores

    def score(self, chosen: list[int]) -> float:
        """The score of a set of passes; minus infinity without one."""
        return float(self.scores_with(chosen[1:])[chosen[0]]) if chosen else -np.inf

    def best(self, most: int) -> list[int]:
        """The passes, at most so many, that have the best score together: by adding, exchanging and
        removing passes while that makes it better.
        """
        begins = np.argsort(-self.scores_with([]), kind="stable")[:BEGINNINGS]
        return max((self._improved([int(begin)], most) for begin in begins), key=self.score)

    def _improved(self, chosen: list[int], most: int) -> list[int]:
        """The set after all changes of one pass that make its score better."""
        least = self.score(chosen)
        while True:
            best, changed = least, chosen
            kept = [chosen[:place] + chosen[place + 1 :] for place in range(len(chosen))]
            for others in [chosen, *kept] if len(chosen) < most else kept:
                scores = self.scores_with(others)
                for score, some in (
                    (float(scores.max()), [*others, int(scores.argmax())]),
                    (self.score(others), others),
                ):
                    if score > best:
                        best, changed = score, some
            if best <= least + 1e-9:
                return chosen
            least, chosen = best, changed


def best_selection(passes: Sequence[TriedPass], most: int) -> list[TriedPass]:
    """The passes, at most so many, that have the best score together."""
    return [passes[number] for number in PassPool(passes).best(most)] if passes else []


def score_of(passes: Sequence[TriedPass]) -> float:
    """The score of passes together; minus infinity without one."""
    return PassPool(passes).score(list(range(len(passes)))) if passes else -np.inf
