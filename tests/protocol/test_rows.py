import pytest

from lerobot_uca.protocol.rows import CorruptRow, Row, read_rows, write_rows

ROWS = [
    Row("metaworld/reach", "uca_flow", 0, 800, 25.6, False, 2_000_000 + index, bool(index % 2), 0.1 + index, 200, 5.125)
    for index in range(4)
]


def test_rows_come_back_as_they_were_written(tmp_path):
    path = tmp_path / "rows.csv"
    write_rows(path, ROWS)
    assert list(read_rows(path)) == ROWS
    assert [file.name for file in tmp_path.iterdir()] == ["rows.csv"]
    assert path.read_text().splitlines()[1] == "metaworld/reach,uca_flow,0,800,25.6,0,2000000,0,0.1,200,5.125"


def test_a_file_is_whole_or_not_there(tmp_path):
    """The process may be killed in the middle."""

    def dying():
        yield ROWS[0]
        raise KeyboardInterrupt

    path = tmp_path / "rows.csv"
    with pytest.raises(KeyboardInterrupt):
        write_rows(path, dying())
    assert not path.exists()
    write_rows(path, ROWS)
    with pytest.raises(KeyboardInterrupt):
        write_rows(path, dying())
    assert list(read_rows(path)) == ROWS


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("metaworld/reach,uca_flow,0,8", "it has too many or too few columns"),
        ("metaworld/reach,uca_flow,0,800,25.6,0,2000001,1,0.1,200,5.1,9", "it has too many or too few columns"),
        ("metaworld/reach,uca_flow,0,800,25.6,0,2000001,yes,0.1,200,5.1", "truth is 0 or 1, got 'yes'"),
        ("metaworld/reach,uca_flow,zero,800,25.6,0,2000001,1,0.1,200,5.1", "invalid literal for int"),
        ("\0\0\0", "too"),
    ],
)
def test_a_corrupt_line_is_named_and_the_rest_is_kept(tmp_path, line, reason):
    path = tmp_path / "rows.csv"
    write_rows(path, ROWS)
    lines = path.read_text().splitlines()
    lines[2] = line
    path.write_text("\n".join(lines))
    first, corrupt, *others = read_rows(path)
    assert [first, *others] == [ROWS[0], *ROWS[2:]]
    assert isinstance(corrupt, CorruptRow)
    assert str(corrupt).startswith(f"{path}, line 3 is left out: ")
    assert reason in corrupt.reason


def test_a_file_of_something_else(tmp_path):
    path = tmp_path / "rows.csv"
    path.write_text("a,b\n1,2\n")
    (corrupt,) = read_rows(path)
    assert "the header lacks task, policy" in str(corrupt)
    path.write_text("a" * 200_000)
    (corrupt,) = read_rows(path)
    assert str(corrupt) == f"{path}, line 1 is left out: field larger than field limit (131072)."
