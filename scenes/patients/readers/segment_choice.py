"""Which segments are which tissue: by the user's words, by their names, and not at all where a name is of
a derived structure.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

from errors import PatientError
from scenes.patients.readers.label_maps import LESIONS, LabelMap, Segment, listed, resample_nearest
from scenes.patients.readers.segment_names import is_derived, is_plain_kidney, quoted, same_name

# Segments of one tissue that have this share of the larger in common are the same structure, drawn twice. A
# smaller one with this share of its own in a kidney is something in it.
SAME_STRUCTURE, WITHIN = 0.4, 0.5


def assign_tissues(
    maps: list[LabelMap],
    organ: Sequence[str],
    chosen: Mapping[str, Sequence[str]],
    empty: Sequence[Segment] = (),
) -> list[LabelMap]:
    """The maps with the tissues that the user assigned, by names or values.

    ``organ`` are the segments of the organ; those without a tissue become kidney. ``chosen`` has all segments
    of each tissue; a label assigned to the organ and to a tissue is the tissue. A tissue's value, or its
    segment in ``empty``, the segments of the files that no voxel has, may be absent (``absent_labels``), so
    that one command is right for many patients. Raises PatientError for an absent label of the organ, a name
    that no segment has, and one segment assigned to two tissues.
    """
    segments = _segments(maps)
    for word in [*organ, *(word for words in chosen.values() for word in words)]:
        _check_unambiguous(word, segments)
    has_values = any(segment.value is not None for segment in segments)
    of_tissues = {word for words in chosen.values() for word in words}
    for option, words in {"organ": [word for word in organ if word not in of_tissues], **chosen}.items():
        for word in words:
            may_be_absent = option != "organ" and (
                (has_values and word.isdecimal()) or _is_among(empty, word)
            )
            if not may_be_absent and not _is_among(segments, word):
                raise PatientError(
                    f"the {_in_words(option)}'s label {word} is not in the label map: it has "
                    f"{listed([str(s) for s in segments])}; "
                    "give one of these"
                )

    def assigned(segment: Segment) -> Segment:
        tissues = [tissue for tissue, words in chosen.items() if any(segment.matches(word) for word in words)]
        if len(tissues) > 1:
            raise PatientError(
                f"label {segment} is given as {' and as '.join(map(_in_words, tissues))}: give it as one of "
                "them"
            )
        if tissues:
            return replace(segment, tissue=tissues[0])
        if segment.tissue in chosen:
            segment = replace(segment, tissue=None)
        is_organ = any(segment.matches(word) for word in organ)
        return replace(segment, tissue=segment.tissue or "kidney") if is_organ else segment

    return [replace(one, segments={v: assigned(s) for v, s in one.segments.items()}) for one in maps]


def _check_unambiguous(word: str, segments: Sequence[Segment]) -> None:
    """Raises PatientError where a word is the name of one segment and the value of another, or of names
    that differ in case alone.
    """
    named = [segment for segment in segments if same_name(word, segment.name)]
    valued = [segment for segment in segments if word == str(segment.value) and segment not in named]
    if named and valued:
        raise PatientError(
            f"{quoted(word)} is the name of label {named[0]} and the value of label {valued[0]}; expected "
            "one meaning; rename one of them"
        )
    if len({segment.name for segment in named}) > 1:
        raise PatientError(
            f"{quoted(word)} is the name of {len(named)} labels, which differ in case alone: "
            f"{_listed(named)}; give a value, or rename one"
        )


def absent_labels(maps: list[LabelMap], chosen: Mapping[str, Sequence[str]]) -> tuple[str, ...]:
    """A note for each label of a tissue (tissue -> names or values of its labels) that no voxel has."""
    segments = _segments(maps)
    return tuple(
        f"no voxel has the {_in_words(tissue)}'s label {word if word.isdecimal() else quoted(word)}"
        for tissue, words in chosen.items()
        for word in words
        if not _is_among(segments, word)
    )


def _in_words(tissue: str) -> str:
    """A tissue as the options of an import name it."""
    return "collecting system" if tissue == "urine" else tissue


def _segments(maps: list[LabelMap]) -> list[Segment]:
    return [segment for one in maps for segment in one.segments.values()]


def _is_among(segments: Sequence[Segment], word: str) -> bool:
    return any(segment.matches(word) for segment in segments)


def choose_segments(
    maps: list[LabelMap], words: Collection[str] = (), is_organ_named: bool = False
) -> tuple[list[LabelMap], tuple[str, ...]]:
    """The maps without segments that are no organ, and notes that name these.

    The maps have the tissues that the user assigned; ``words`` are names or values of segments that the user
    named: these are never left out. With ``is_organ_named`` the organ that the user named is the kidney, and
    no other is. Derived structures are left out, and so is a kidney that is drawn a second time under a
    longer name. Other segments that are one structure drawn twice, such as two observers', are united when
    the maps are merged: a note names them. A small segment in a kidney whose name has the word kidney and
    others is a finding of no known tissue. Raises PatientError where nothing else is there.
    """
    derived = [
        segment
        for segment in _segments(maps)
        if is_derived(segment.name) and not any(segment.matches(word) for word in words)
    ]
    twice = _drawn_twice(maps, words, is_organ_named)
    notes = []
    if derived:
        notes.append(
            f"left out, as derived from other structures: {_listed(derived)}; --organ or --tumour with its "
            "name takes one"
        )
    if twice.copies:
        names = _listed([*dict.fromkeys(twice.copies)])
        notes.append(f"left out, as the kidney is there under a plain name: {names}; --organ takes one")
    notes += [f"united, as they are one structure drawn twice: {_listed(pair)}" for pair in twice.united]
    kept = _without(maps, [*derived, *twice.copies], twice.findings)
    if not kept:
        raise PatientError(
            f"the labels are only of structures that were derived from others: {_listed(derived)}; expected "
            "a kidney; choose other labels, "
            "or name the kidney's with --organ"
        )
    return kept, tuple(notes)


def _listed(segments: Sequence[Segment]) -> str:
    return listed([str(segment) for segment in segments])


@dataclass(frozen=True)
class _DrawnTwice:
    """Segments that other segments of their tissue cover."""

    copies: list[Segment]  # kidneys under a longer name than one that is there
    united: list[tuple[Segment, Segment]]
    findings: list[Segment]  # small, in a kidney


def _drawn_twice(maps: list[LabelMap], words: Collection[str], is_organ_named: bool) -> _DrawnTwice:
    twice = _DrawnTwice([], [], [])
    pieces = [
        (one, v, s) for one in maps for v, s in one.segments.items() if s.tissue in ("kidney", *LESIONS)
    ]
    for (one, value, first), (other, other_value, second) in combinations(pieces, 2):
        if one is other or first.tissue != second.tissue:
            continue
        of_larger, of_smaller, is_first_smaller = _shares_in_common(one, value, other, other_value)
        longer = [
            s for s in (first, second) if not is_plain_kidney(s.name) and not any(map(s.matches, words))
        ]
        smaller = first if is_first_smaller else second
        is_kidney = first.tissue == "kidney"
        if of_larger < SAME_STRUCTURE:
            if is_kidney and of_smaller >= WITHIN and smaller in longer:
                twice.findings.append(smaller)
        elif is_kidney and is_organ_named:
            continue
        elif is_kidney and len(longer) == 1:
            twice.copies.extend(longer)
        else:
            twice.united.append((first, second))
    return twice


def _shares_in_common(
    one: LabelMap, value: int, other: LabelMap, other_value: int
) -> tuple[float, float, bool]:
    """The share of the larger and of the smaller of two segments that both cover, and whether the first is
    smaller.
    """
    (low, high), (other_low, other_high) = one.grid.bounds(), other.grid.bounds()
    if (low > other_high).any() or (other_low > high).any():
        return 0.0, 0.0, False
    mine, its = one.values == value, other.values == other_value
    ml, other_ml = float(mine.sum() * one.grid.voxel_ml), float(its.sum() * other.grid.voxel_ml)
    both_ml = float((mine & resample_nearest(other.grid, its, one.grid)).sum() * one.grid.voxel_ml)
    return both_ml / max(ml, other_ml), both_ml / min(ml, other_ml), ml < other_ml


def _without(
    maps: list[LabelMap], left_out: Sequence[Segment], findings: Sequence[Segment]
) -> list[LabelMap]:
    """The maps without those of segments that are left out; beside others in a map these have no tissue,
    as findings have none.
    """
    kept = []
    for one in maps:
        segments = {
            v: replace(s, tissue=None) if s in left_out or s in findings else s
            for v, s in one.segments.items()
        }
        if any(segment not in left_out for segment in one.segments.values()):
            kept.append(replace(one, segments=segments))
    return kept


def with_commas(words: Sequence[str], maps: list[LabelMap], empty: Sequence[Segment] = ()) -> list[str]:
    """The user's words, which a list was split into at its commas, joined again where a segment's name has
    commas.
    """
    joined = list(words)
    for segment in [*_segments(maps), *empty]:
        parts = [part.strip() for part in segment.name.split(",")]
        for start in range(len(joined) - len(parts) + 1):
            run = joined[start : start + len(parts)]
            if len(parts) > 1 and Segment.named(",".join(parts)).matches(",".join(run)):
                joined[start : start + len(parts)] = [segment.name]
                break
    return joined
