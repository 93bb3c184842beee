"""What `make check` says of source that is not in order."""

import pytest
from tools.check_source import check_source

FINE = '''"""Nothing."""\n'''
WRONG = {
    "imports envs, which is built on it": {
        "geometry/a.py": "from pack.envs.b import c",
        "envs/b.py": FINE,
    },
    "settings imports envs, which": {
        "settings.py": "import pack.envs.b",
        "envs/b.py": FINE,
    },
    "'limbs' has no place": {"limbs/a.py": FINE},
    "imports in a circle": {
        "envs/a.py": "from pack.envs.b import c",
        "envs/b.py": "def d():\n    from pack.envs.a import c",
    },
    "imports tests, which is outside": {"envs/a.py": "import tests.x"},
    "refuse raises, and no docstring": {
        "envs/a.py": 'def refuse():\n    """Nothing."""\n    raise ValueError'
    },
    "__init__ raises, and no docstring": {
        "envs/a.py": "class A:\n    def __init__(self):\n        raise ValueError"
    },
}


@pytest.mark.parametrize("said", WRONG)
def test_what_is_wrong_is_said(said, tmp_path):
    for name, text in WRONG[said].items():
        path = tmp_path / "pack" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    (found,) = check_source(tmp_path / "pack")
    assert said in found


def test_what_is_right_is_not(tmp_path):
    folder = tmp_path / "pack" / "envs"
    folder.mkdir(parents=True)
    (folder / "a.py").write_text("from pack.geometry.b import c\nimport pack.settings")
    (folder / "d.py").write_text(
        'def e():\n    """Raises: always."""\n    raise KeyError'
    )
    (tmp_path / "pack" / "geometry").mkdir()
    (tmp_path / "pack" / "geometry" / "b.py").write_text(FINE)
    (tmp_path / "pack" / "settings.py").write_text(FINE)
    assert not check_source(tmp_path / "pack")
