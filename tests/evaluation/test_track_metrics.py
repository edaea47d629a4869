import contextlib
import io

import numpy as np
import pytest

from shapepose_fg.evaluation.track_metrics import TrackFrame, track_metrics


def recording(seed, *, apart=1.0, people=4, frames=40):
    """People who walk about, with misses, false positives, noise and exchanged identities."""
    rng = np.random.default_rng(seed)
    place = apart * rng.normal(size=(people, 3)) * [4, 4, 0.2]
    made = list[TrackFrame]()
    for _ in range(frames):
        place = place + 0.05 * rng.normal(size=place.shape)
        true = np.flatnonzero(rng.random(people) < 0.9)
        whose = np.where(rng.random(people) < 0.95, np.arange(people), rng.permutation(people))
        found = np.flatnonzero(rng.random(people) < 0.9)
        _, first = np.unique(whose[found], return_index=True)
        found = found[first]
        at = place[whose[found]] + 0.15 * rng.normal(size=(len(found), 3))
        distance = np.linalg.norm(place[true][:, None] - at, axis=2)
        made.append(TrackFrame(3 * true + 1, 7 * found, np.maximum(0, 1 - distance)))
    return made


def by_trackeval(frames):
    without = "needs pip install --no-deps trackeval: its OpenCV would replace the headless one"
    trackeval = pytest.importorskip("trackeval", reason=without)
    names = [np.unique(np.concatenate([each[side] for each in frames])) for side in (0, 1)]
    ids = [[np.searchsorted(names[side], each[side]) for each in frames] for side in (0, 1)]
    data = {
        "gt_ids": ids[0],
        "tracker_ids": ids[1],
        "similarity_scores": [each.similarity for each in frames],
        "num_gt_ids": len(names[0]),
        "num_tracker_ids": len(names[1]),
        "num_gt_dets": sum(map(len, ids[0])),
        "num_tracker_dets": sum(map(len, ids[1])),
        "num_timesteps": len(frames),
    }
    with contextlib.redirect_stdout(io.StringIO()):
        kinds = (getattr(trackeval.metrics, name)() for name in ("HOTA", "CLEAR", "Identity"))
        hota, clear, identity = (kind.eval_sequence(data) for kind in kinds)
    means = {"hota": "HOTA", "det_a": "DetA", "ass_a": "AssA", "loc_a": "LocA"}
    figures = {name: float(np.mean(hota[key])) for name, key in means.items()}
    counts = {"misses": "CLR_FN", "false_positives": "CLR_FP", "switches": "IDSW"}
    figures |= {name: clear[key] for name, key in counts.items()}
    return figures | {"mota": clear["MOTA"], "idf1": identity["IDF1"]}


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize("apart", [0.2, 1.0])
def test_agrees_with_trackeval(seed, apart):
    """Also where people are so near that several matches are possible."""
    frames = recording(seed, apart=apart)
    ours, figures = track_metrics(frames), by_trackeval(frames)
    assert {name: getattr(ours, name) for name in figures} == pytest.approx(figures, abs=1e-9)
    assert 0.1 < ours.hota < 0.99


@pytest.mark.parametrize("seed", range(6))
def test_agrees_with_motmetrics(seed):
    """Where people are apart. In ambiguous frames the two packages differ in MOTA: motmetrics keeps
    pairs that were matched at any time before, trackeval those of the previous frame.
    """
    motmetrics = pytest.importorskip("motmetrics", reason="motmetrics is not installed")
    frames, near = recording(seed, apart=3.0), recording(seed, apart=0.2)
    for each, names in ((frames, ("mota", "idf1", "num_switches")), (near, ("idf1",))):
        events = motmetrics.MOTAccumulator(auto_id=True)
        for true, predicted, similarity in each:
            distance = np.where(similarity >= 0.5, 1 - similarity, np.nan)
            events.update(true, predicted, distance)
        table = motmetrics.metrics.create().compute(events, metrics=list(names), name="all")
        ours = track_metrics(each)
        values = {"mota": ours.mota, "idf1": ours.idf1, "num_switches": ours.switches}
        for name in names:
            assert values[name] == pytest.approx(float(table[name].iloc[0]), abs=1e-9)


def test_by_hand():
    """Two people in four frames; in the last two, the identities are exchanged."""
    here = np.eye(2)
    frames = [TrackFrame(np.array([1, 2]), np.array(ids), here)
              for ids in ([5, 6], [5, 6], [6, 5], [6, 5])]  # fmt: skip
    ours = track_metrics(frames)
    assert (ours.misses, ours.false_positives, ours.switches) == (0, 0, 2)
    assert ours.mota == pytest.approx(1 - 2 / 8)
    assert ours.idf1 == pytest.approx(0.5)
    # Each match has TPA 2, FNA 2 and FPA 2.
    assert ours.hota == pytest.approx(np.sqrt(1 / 3))
    assert ours.loc_a == 1


def test_nothing_to_measure():
    nobody, someone = np.zeros(0, dtype=int), np.array([4])
    lost = track_metrics([TrackFrame(someone, nobody, np.zeros((1, 0)))])
    assert (lost.mota, lost.idf1, lost.hota, lost.misses) == (0, 0, 0, 1)
    false = track_metrics([TrackFrame(nobody, someone, np.zeros((0, 1)))])
    assert (false.hota, false.false_positives) == (0, 1) and np.isnan(false.mota)
    assert np.isnan(track_metrics([]).idf1)
    with pytest.raises(ValueError, match="twice"):
        track_metrics([TrackFrame(np.array([1, 1]), someone, np.ones((2, 1)))])
