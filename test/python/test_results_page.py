import pytest

from iwgnet_grasp.report.results_page import SECTIONS, read_sections, write_section


def test_sections_stand_in_the_page_s_order_and_are_replaced_alone(tmp_path):
    page = tmp_path / "results.md"
    for name in reversed(SECTIONS):
        write_section(name, f"## {name}\n\nold", page)
    write_section(SECTIONS[1], "## new", page)
    sections = read_sections(page)
    assert list(sections) == list(SECTIONS)
    assert sections.pop(SECTIONS[1]) == "## new"
    assert all(text.endswith("old") for text in sections.values())


def test_unknown_section_is_refused_and_nothing_is_written(tmp_path):
    page = tmp_path / "results.md"
    with pytest.raises(ValueError, match="learning"):
        write_section("appendix", "text", page)
    assert not page.exists()
