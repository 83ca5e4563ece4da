"""Splits that transforms.json lists, as nerfstudio has them."""

import pytest
from support.datasets import edit, load_noting, refusal

IMAGES = [f"images/{i:02d}.png" for i in range(10)]
LISTS = {"train": IMAGES[:6], "val": IMAGES[6:8], "test": IMAGES[8:]}


def give(folder, **lists):
    """Add lists by split."""
    lists = {f"{split}_filenames": names for split, names in lists.items()}
    edit(folder / "transforms.json", lambda meta: meta.update(lists))


def names(views):
    return [int(view.name) for view in views]


@pytest.mark.parametrize(
    ("splits", "test_split", "train", "test"),
    [
        (("train", "val", "test"), None, range(6), [8, 9]),
        (("train", "val", "test"), "val", range(6), [6, 7]),
        (("train", "val", "test"), "train", range(6), range(6)),
        (("train", "val"), None, range(6), [6, 7]),
        (("test",), None, range(8), [8, 9]),
        (("val", "test"), None, range(6), [8, 9]),
        (("train",), None, range(6), range(6, 10)),
    ],
)
def test_lists_define_the_splits(photographs, splits, test_split, train, test):
    give(photographs, **{split: LISTS[split] for split in splits})
    dataset, notes = load_noting(photographs, test_split=test_split)
    assert names(dataset.train) == list(train) and names(dataset.test) == list(test)
    assert dataset.test_split == (test_split or ("val" if splits == ("train", "val") else "test"))
    unlisted = splits == ("train", "val")
    assert [": left out, as " in note for note in notes] == [True] * unlisted
    if unlisted:
        assert "2 of 10 photographs (images/08.png, images/09.png)" in notes[0]


def test_names_are_compared_as_paths_without_case_and_suffix(photographs):
    give(photographs, train=["./images/00.png", "images\\01.png", "02", "IMAGES/03.PNG"])
    assert names(load_noting(photographs)[0].train) == [0, 1, 2, 3]


def test_unknown_and_missing_names_are_reported(photographs):
    path = photographs / "transforms.json"
    give(photographs, test=["images/02.png", "images/xx.png"])
    dataset, notes = load_noting(photographs)
    assert names(dataset.test) == [2]
    assert notes == [f"{path}: test_filenames has names that no frame has: images/xx.png"]
    give(photographs, **LISTS)
    (photographs / IMAGES[8]).unlink()
    dataset, notes = load_noting(photographs)
    assert names(dataset.test) == [9]
    assert len(notes) == 1 and "not there: 1 of 10 photographs (images/08.png)" in notes[0]


@pytest.mark.parametrize(
    ("lists", "test_split", "message"),
    [
        ({"test": ["images/2.jpg", "x"]}, None, "but 2 of its 2 names are not theirs: images/2.jp"),
        ({"train": IMAGES, "test": IMAGES[3:5]}, None, "have 2 in both train and test: images/03."),
        ({"test": IMAGES[:2]}, "val", "there is no split val, only test; set data.test_split"),
        (
            {"test": IMAGES},
            None,
            "at least 1 view of the splits train and test is needed, and test",
        ),
        ({"test": ["a", 3]}, None, "test_filenames[1] must be text, got 3"),
    ],
)
def test_contradictory_lists_are_refused(photographs, lists, test_split, message):
    give(photographs, **lists)
    refused = refusal(photographs, test_split=test_split)
    assert refused.startswith(f"{photographs / 'transforms.json'}: ") and message in refused


def test_list_file_defines_the_split(photographs):
    (photographs / "train.txt").write_text("loss 0.5\nloss 0.4\n")  # a log of some program
    (photographs / "test.txt").write_text("images/03.png\n05\n")
    dataset, notes = load_noting(photographs)
    assert names(dataset.test) == [3, 5] and len(dataset.train) == 8
    assert notes == [f"{photographs}/train.txt: lists no photograph, and is not read"]


@pytest.mark.parametrize("name", ["03", "03.png", "images/03.png", "images/03"])
def test_photographs_are_left_out_by_name(photographs, name):
    everything, _ = load_noting(photographs)
    dataset, _ = load_noting(photographs, leave_out=[name, "08"])
    assert sorted(names((*dataset.train, *dataset.test))) == [0, 1, 2, 4, 5, 6, 7, 9]
    assert set(names(dataset.test)) == set(names(everything.test)) - {3, 8}  # the split stays
    assert dataset.description.endswith("; 2 left out")


@pytest.mark.parametrize("broken", ["cut", "empty", "text"])
def test_photographs_that_are_left_out_are_not_opened(photographs, broken):
    file = next(photographs.rglob("03.png"))
    content = file.read_bytes()
    file.write_bytes({"cut": content[:-300], "empty": b"", "text": b"no image"}[broken])
    dataset, _ = load_noting(photographs, leave_out=["03"])
    assert sorted(names((*dataset.train, *dataset.test))) == [0, 1, 2, 4, 5, 6, 7, 8, 9]
    found = refusal(photographs)
    assert "03.png: cannot read the image" in found
    assert found.endswith("; or leave it out: --leave-out images/03.png")


@pytest.mark.parametrize(
    ("left_out", "message"),
    [
        (["3"], "data.leave_out: {} has no photograph 3"),
        (["03.jpg"], "has no photograph 03.jpg"),
        (["other/03.png"], "has no photograph other/03.png"),
        ([""], "has no photograph "),
        ([f"{k:02d}" for k in range(10)], "data.leave_out: no photograph is left to train on"),
        (["03", "nowhere"], "has no photograph nowhere"),
    ],
)
def test_names_of_no_photograph_are_refused(photographs, left_out, message):
    found = refusal(photographs, leave_out=left_out)
    assert message.format(photographs) in found, found
