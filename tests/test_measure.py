"""The README's measurements: the tables appear, and the errors in them are those of a working backend."""

from tolerances import PARITY_FLOAT32_IMAGE, PARITY_FLOAT64

from data_tools.measure import measure_stages


def test_stage_table(capsys):
    measure_stages(400, repeats=1)
    rows = [line.split(" | ") for line in capsys.readouterr().out.splitlines() if line.startswith("| cpu")]
    assert [row[0].strip("| ") + " " + row[1] for row in rows] == ["cpu float32", "cpu-exact float32", "cpu float64"]
    assert all(0 < float(row[5]) < PARITY_FLOAT32_IMAGE for row in rows[:2])
    assert float(rows[2][5]) < PARITY_FLOAT64
    assert all(float(row[2]) > 0 and float(row[3]) > 0 for row in rows)
