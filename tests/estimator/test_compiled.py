"""The cache of compiled loops is invalidated by a change in any of their source files."""

from pathlib import Path

from hil.estimator import compiled
from hil.estimator.simulation import arm, sensitivity


def test_a_change_of_any_compiled_source_changes_the_digest(tmp_path: Path) -> None:
    for folder in compiled.FOLDERS:
        (tmp_path / folder / "deeper").mkdir(parents=True)
        (tmp_path / folder / "deeper" / "one.py").write_text("A = 1\n", encoding="utf-8")
    seen = {compiled.sources_digest(tmp_path)}
    for folder in compiled.FOLDERS:
        (tmp_path / folder / "deeper" / "one.py").write_text("A = 2\n", encoding="utf-8")
        compiled.sources_digest.cache_clear()
        seen.add(compiled.sources_digest(tmp_path))
    compiled.sources_digest.cache_clear()
    assert len(seen) == 1 + len(compiled.FOLDERS)


def test_loops_are_kept_under_the_digest_of_all_sources() -> None:
    digest = compiled.sources_digest(Path(compiled.__file__).parent)
    for loop in (arm._simulate, sensitivity._advance):
        assert loop._cache._cache_file._source_stamp[1] == digest  # type: ignore[attr-defined]
