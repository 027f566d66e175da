"""CITATION.cff, which GitHub and Zenodo read, against what the Citation File Format 1.2.0 requires."""

import re

import yaml

from conftest import ROOT


def test_the_citation_has_what_its_format_requires_and_this_version():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    (thesis,) = citation["references"]
    assert citation["cff-version"] == "1.2.0" and citation["type"] == "software" and thesis["type"] == "thesis"
    for cited, required in ((citation, ("message", "title")), (thesis, ("title",))):
        assert all(isinstance(cited[key], str) and cited[key] for key in required)
        assert cited["authors"] and all(author["name"] for author in cited["authors"])
    project = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    assert citation["version"] == re.search(r'^version = "(.*)"$', project, re.MULTILINE)[1]
    assert thesis["title"] in (ROOT / "README.md").read_text(encoding="utf-8")
