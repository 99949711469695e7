"""Files as other programs and people leave them: each case of ``python -m data_tools.foreign_files``."""

import pytest

from data_tools.foreign_files.kinds import KINDS

CASES = [pytest.param(case, id=f"{kind}-{name}") for kind, cases in KINDS.items() for name, case in cases.items()]


@pytest.mark.parametrize("case", CASES)
def test_foreign_file(case, tmp_path):
    case(tmp_path)
