"""README.md of a data folder: what a hub reads, what a reader runs, and whose page it is."""

import hashlib
import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import yaml

from acwm_core.data.card import DatasetCard
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.data.generate import generate
from acwm_core.data.readme import MARK, README, write_readme


def page(folder):
    return (folder / README).read_text(encoding="utf-8")


def front_matter(folder):
    _, matter, _ = page(folder).split("---\n", 2)
    return yaml.safe_load(matter)


def snippets(text):
    return [part.partition("```")[0] for part in text.split("```python\n")[1:]]


def table_row(text, name):
    (row,) = [line for line in text.splitlines() if line.startswith(f"| `{name}` |")]
    return [cell.strip() for cell in row.strip("|").split("|")]


def test_the_hub_finds_the_shards_of_each_split(square_data):
    matter = front_matter(square_data)
    files = matter["configs"][0]["data_files"]
    assert [each["split"] for each in files] == ["train", "ind_test", "ood_test"]
    for each in files:
        found = {path.name for path in square_data.glob(each["path"])}
        assert found == {path.name for path in (square_data / each["split"]).glob("shard-*")}
    assert matter["size_categories"] == ["n<1K"]
    assert matter["license"] == "unknown"
    assert {"webdataset", "simulation"} <= set(matter["tags"])


def test_the_page_counts_what_is_there(square_data):
    for split in ("train", "ind_test", "ood_test"):
        episodes = EpisodeDataset(square_data, split)
        tars = list((square_data / split).glob("*.tar"))
        _, count, frames, shards, size = table_row(page(square_data), split)
        assert int(count) == len(episodes)
        assert int(frames) == sum(len(episodes.actions(i)) for i in range(len(episodes)))
        assert int(shards) == len(tars)
        assert int(size.replace(",", "")) == sum(tar.stat().st_size for tar in tars)


def test_card_and_page_hold_the_checksum_of_the_checksums(square_data):
    card = DatasetCard.read(square_data)
    for split in card.splits:
        tars = sorted((square_data / split).glob("*.tar"))
        each = [hashlib.sha256(tar.read_bytes()).hexdigest() for tar in tars]
        assert card.checksums[split] == hashlib.sha256("\n".join(each).encode()).hexdigest()
        assert f"    {card.checksums[split]}  {split}\n" in page(square_data)


def test_what_the_page_tells_readers_to_run_reads_the_data(square_data):
    ours, plain = snippets(page(square_data))
    ours = ours.replace("PATH OR URL OF THIS FOLDER", str(square_data))
    report = "\nprint(float(actions.sum()), [int(image.sum()) for image in video])"
    last = "actions, video = episode.actions, episode.video"
    told = [_output(code + report, square_data) for code in (ours + last, plain)]
    episodes = EpisodeDataset(square_data, "train")
    for place, output in zip((0, len(episodes) - 1), told, strict=True):  # plain ends at the last
        total, sums = output.split(" ", 1)
        episode = episodes[place]
        np.testing.assert_allclose(float(total), episode.actions.sum(), rtol=1e-5, atol=1e-5)
        assert json.loads(sums) == [int(image.sum()) for image in episode.video]


def _output(code, folder):
    command = [sys.executable, "-W", "ignore", "-c", code]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_a_page_of_somebody_stays_and_a_page_of_acwm_follows_the_data(tmp_path):
    out = tmp_path / "square"

    def make(split, **settings):
        generate("square", out, episodes={split: 2}, workers=0, progress=False, **settings)

    make("ind_test")
    assert "`ood_test` |" not in page(out)
    make("ood_test")
    assert table_row(page(out), "ood_test")[1] == "2"
    mine = page(out).replace(MARK, "").replace("license: unknown", "license: cc-by-4.0")
    (out / README).write_text(mine, encoding="utf-8")
    make("ind_test")
    assert page(out) == mine


def test_factors_that_were_set_and_recorded_data_are_told(square_data, tmp_path):
    card = DatasetCard.read(square_data)
    write_readme(tmp_path, replace(card, factors={"hue": "ood"}, splits={"train": 1}))
    assert "In this dataset `hue=ood`." in page(tmp_path)
    environment = replace(card.environment, factors=(), state=(), instances=(), summary="")
    source = {"kind": "python", "name": "mine", "notes": ["train: 1 of 2 are short | cut"]}
    write_readme(
        tmp_path, replace(card, environment=environment, source=source, splits={"train": 1})
    )
    assert "simulation" not in front_matter(tmp_path)["tags"]
    assert "Recorded: videos" in page(tmp_path)
    assert "- train: 1 of 2 are short | cut" in page(tmp_path)
    for absent in ("## Factors", "## Ground truth", "Instance ids"):
        assert absent not in page(tmp_path)
