"""The page of the notebooks: titles, and links to Colab and Binder where the repository has an address."""

import pytest

from data_tools import notebook_page
from data_tools.notebook_page import PAGE, main, page, repository_of

TEXTS = {"01_a_b": "# ---\n# %% [markdown]\n# # 01 Covariance and projection\n#\n# text", "00_guide": "# # 00 Guide"}


def test_the_page_is_the_one_that_is_stored(capsys):
    assert main(["--check"]) == 0, capsys.readouterr().out
    assert "[06 Training a tiny scene](06_training_a_tiny_scene.ipynb)" in PAGE.read_text(encoding="utf-8")


def test_without_an_address_there_are_no_links():
    text = page(TEXTS, {"Mini-Splatting": "https://arxiv.org/abs/2403.14166"})
    table = text[text.index("| notebook") :]
    assert (
        table
        == "| notebook |\n| --- |\n| [00 Guide](00_guide.ipynb) |\n| [01 Covariance and projection](01_a_b.ipynb) |\n"
    )
    assert "https" not in text


def test_with_an_address_every_notebook_has_both():
    text = page(TEXTS, {"Repository": "https://github.com/someone/splats"})
    assert "[Colab](https://colab.research.google.com/github/someone/splats/blob/main/notebooks/01_a_b.ipynb)" in text
    assert "[Binder](https://mybinder.org/v2/gh/someone/splats/main?labpath=notebooks%2F01_a_b.ipynb)" in text
    assert "git clone --quiet https://github.com/someone/splats && pip install --quiet './splats[notebooks]'" in text
    assert "%cd splats/notebooks" in text and text.count("[Colab]") == text.count("[Binder]") == 2


@pytest.mark.parametrize(
    ("url", "expected"),
    [
        ("https://github.com/a/b", "a/b"),
        ("https://github.com/a/b.git", "a/b"),
        ("https://github.com/a/b.c/", "a/b.c"),
        ("https://gitlab.com/a/b", None),
        ("https://github.com/a", None),
        ("https://github.com/a/b/tree/main", None),
        ("", None),
    ],
)
def test_only_repositories_on_github_count(url, expected):
    assert repository_of({"Repository": url}) == expected


def test_a_page_that_differs_is_named_and_written(tmp_path, monkeypatch, capsys):
    (tmp_path / "notebooks").mkdir()
    (tmp_path / "notebooks" / "00_guide.py").write_text("# # 00 Guide\n")
    (tmp_path / "pyproject.toml").write_text("[project]\n[project.urls]\n")
    monkeypatch.setattr(notebook_page, "ROOT", tmp_path)
    monkeypatch.setattr(notebook_page, "PAGE", tmp_path / "notebooks" / "README.md")
    assert main(["--check"]) == 1 and "differs: python -m data_tools.notebook_page" in capsys.readouterr().out
    assert not (tmp_path / "notebooks" / "README.md").exists()
    assert main([]) == 0 and main(["--check"]) == 0
    (tmp_path / "notebooks" / "00_guide.py").write_text("no headline\n")
    with pytest.raises(ValueError, match=r"00_guide\.py has no headline"):
        main([])
