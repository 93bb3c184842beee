"""Words of the glossary's left column are found; sizes are counted."""

import pytest
from tools.check_words import hits
from tools.size import LONGEST, ROOT, count_comments, measure


@pytest.mark.parametrize(
    "line",
    [
        "the true dynamics of a robot",
        "beside the truth",
        "class GroundedNeRD(NeRD):",
        "rollout_lr: float = 1.0",
        "def fault_folder(self):",
        "num_looks = 2",
        "--own-actions",
        "Coverage.distance",
        "planes that differ from row to row",
        "def is_per_row(self):",
        "symmetry images of a hybrid",
        "            drag = friction_force(slip)",
        "self.mount = 1",
        "true_share: float = 0.25",
        "def look(network, size):",
        "the tokens that a network remembers",
    ],
)
def test_a_replaced_word_is_found(line):
    assert [hit.line for hit in hits("a.py", f"x = 1\n{line}\n")] == [2]


@pytest.mark.parametrize(
    "line",
    [
        "the ground truth of a robot",
        "ground_truth = MujocoDynamics(scene)",
        "GroundTruthEnv, GROUND_TRUTH",
        "rollout_lr_ratio: float = 1.0",
        "a method, metrics and a metre",
        "gaps to the ground",
        "every row of a table, and each row of the matrix",
        "images of a camera",
        "gain == AFFINE, and is True",
        "look_up('network', kind, NETWORKS)",
    ],
)
def test_other_words_are_not(line):
    assert not list(hits("a.py", line))


def test_lines_and_comments_are_counted(tmp_path):
    text = '"""Text with # in it."""\n\nx = "# none"  # one\n# two\n'
    (tmp_path / "a.py").write_text(text)
    assert count_comments(text) == 2
    assert measure(tmp_path) == ({"a.py": 4}, 2)


def test_no_file_of_the_package_is_too_long():
    lines, _ = measure(ROOT / "torchrl_nerd")
    assert {path: count for path, count in lines.items() if count > LONGEST} == {}
