"""A LeRobotDataset becomes a log with the same angles, commands, times and episodes."""

import json

import numpy as np
import pyarrow
import pyarrow.parquet as parquet
import pytest

from brokk_min.identification.logs import read_log
from brokk_min.machine import BROKK_170
from examples.lerobot_log import main

NAMES = ["boom.pos", "arm.pos"]


def write_dataset(folder, names, version="v3.0", actions=None):
    """Two episodes of 30 rows in two files; the second one continues in the second file."""
    (folder / "meta").mkdir(parents=True)
    feature = {"dtype": "float32", "shape": [2], "names": names}
    features = {"observation.state": feature, "action": feature | {"names": actions or names}}
    info = {"codebase_version": version, "fps": 20, "features": features}
    (folder / "meta" / "info.json").write_text(json.dumps(info))
    rng = np.random.default_rng(0)
    q = rng.uniform(-0.001, 0.001, (60, 2)).cumsum(axis=0)
    u = rng.uniform(-1, 1, (60, 2))
    time, episode = np.tile(np.arange(30) / 20, 2), np.repeat([0, 1], 30)
    for i, rows in enumerate((slice(0, 40), slice(40, 60))):
        data = {"observation.state": q[rows].tolist(), "action": u[rows].tolist()}
        data |= {"timestamp": time[rows], "episode_index": episode[rows]}
        chunk = folder / "data" / "chunk-000"
        chunk.mkdir(parents=True, exist_ok=True)
        parquet.write_table(pyarrow.table(data), chunk / f"file-{i:03d}.parquet")
    return u, q


@pytest.mark.parametrize("names", [NAMES, {"motors": NAMES}])
def test_main__writes_each_episode_as_a_recording(tmp_path, names, capsys):
    u, q = write_dataset(tmp_path / "set", names)
    main(str(tmp_path / "set"), str(tmp_path / "log.npz"))
    assert "2 episodes of boom, arm" in capsys.readouterr().out
    log = read_log(tmp_path / "log.npz", BROKK_170)
    assert log.joints == ("boom", "arm")
    assert [one.name for one in log.recordings] == ["episode_0", "episode_1"]
    np.testing.assert_allclose(np.concatenate([one.q for one in log.recordings]), q)
    np.testing.assert_allclose(np.concatenate([one.u for one in log.recordings]), u)


def test_main__finds_actions_by_their_names(tmp_path):
    u, _ = write_dataset(tmp_path / "set", NAMES, actions=NAMES[::-1])
    main(str(tmp_path / "set"), str(tmp_path / "log.npz"))
    log = read_log(tmp_path / "log.npz", BROKK_170)
    np.testing.assert_allclose(np.concatenate([one.u for one in log.recordings]), u[:, ::-1])
    write_dataset(tmp_path / "other", NAMES, actions=["boom.pos", "x"])
    places = {"arm.pos": 1, "boom.pos": 0}
    write_dataset(tmp_path / "places", places, actions=NAMES)
    main(str(tmp_path / "places"), str(tmp_path / "log.npz"))
    assert read_log(tmp_path / "log.npz", BROKK_170).joints == ("boom", "arm")
    write_dataset(tmp_path / "nested", NAMES, actions=[["boom.pos"], ["arm.pos"]])
    with pytest.raises(ValueError, match=r"nested: expected a LeRobotDataset with a list of names"):
        main(str(tmp_path / "nested"), str(tmp_path / "log.npz"))
    with pytest.raises(ValueError, match=r"expected action of \['boom', 'arm'\], got .*'x'"):
        main(str(tmp_path / "other"), str(tmp_path / "log.npz"))


def test_main__refuses_another_version(tmp_path):
    write_dataset(tmp_path / "set", NAMES, version="v2.1")
    with pytest.raises(ValueError, match=r"expected v3, .* got v2\.1"):
        main(str(tmp_path / "set"), str(tmp_path / "log.npz"))
    assert not (tmp_path / "log.npz").exists()
