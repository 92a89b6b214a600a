"""Sets of passes: their score against a sum by hand, and that the best of them is found."""

from itertools import combinations

import numpy as np
import pytest

from rehearsal.planning.pass_selection import TRANSFER_MM, PassPool, best_selection, score_of
from rehearsal.planning.sweep_score import MEANS, ScoreTerms, TriedPass, score


def tried(
    seen: np.ndarray, means: tuple = (1.0, 0.0, 0.8, 10.0), poses: int = 20, path_mm: float = 30.0
) -> TriedPass:
    return TriedPass(np.zeros(0), seen, poses * np.array(means), poses, path_mm)


def random_passes(count: int, seed: int = 1) -> list[TriedPass]:
    random = np.random.default_rng(seed)
    return [
        tried(
            np.abs(np.linspace(0, 1, 300) - random.uniform()) < random.uniform(0.05, 0.2),
            (random.uniform(0, 3), random.uniform(0, 0.2), random.uniform(), random.uniform(0, 40)),
            int(random.integers(5, 60)),
            random.uniform(5, 80),
        )
        for _ in range(count)
    ]


def score_by_hand(passes: list[TriedPass]) -> float:
    poses = sum(each.poses for each in passes)
    means = {name: sum(each.sums[k] for each in passes) / poses for k, name in enumerate(MEANS)}
    path_mm = sum(each.path_mm for each in passes) + TRANSFER_MM * (len(passes) - 1)
    seen = sum(any(each.seen[place] for each in passes) for place in range(300)) / 300
    return score(ScoreTerms(seen=seen, path_mm=path_mm, reachable=1.0, **means))


def test_a_set_has_the_score_of_its_terms():
    pool = random_passes(7)
    for chosen in ([], [0], [2, 3, 4]):
        wanted = [
            -np.inf if number in chosen else score_by_hand([*(pool[k] for k in chosen), each])
            for number, each in enumerate(pool)
        ]
        # The seen places are counted in float32, which has whole numbers.
        assert PassPool(pool).scores_with(chosen) == pytest.approx(wanted, abs=1e-4)
    assert score_of(pool[:3]) == pytest.approx(score_by_hand(pool[:3])) and score_of([]) == -np.inf


def test_the_passes_that_share_the_target_are_found_among_others():
    places = np.linspace(0, 1, 300, endpoint=False)
    thirds = [tried((places >= k / 3) & (places < (k + 1) / 3)) for k in range(3)]
    decoys = [tried(np.abs(places - at) < 0.12) for at in (0.2, 0.33, 0.5, 0.66, 0.9)]
    found = best_selection([*decoys, *thirds], 6)
    assert {id(each) for each in found} == {id(each) for each in thirds}


@pytest.mark.parametrize("seed", range(4))
def test_the_best_set_is_the_best_of_all(seed):
    pool = random_passes(8, seed)
    sets = [list(some) for count in range(1, 5) for some in combinations(pool, count)]
    assert score_of(best_selection(pool, 4)) == pytest.approx(max(score_by_hand(some) for some in sets))


def test_a_set_has_no_more_passes_than_a_sweep_may_have():
    places = np.arange(300)
    many = [tried(places // 20 == k) for k in range(15)]
    assert [len(best_selection(many, most)) for most in (1, 4, 6)] == [1, 4, 6]
    assert best_selection([], 4) == []
