import pytest

from mabl.errors import UserError
from mabl.training.memory import check_memory


def test_too_little_memory_is_a_user_error_before_allocation():
    check_memory(100, None)
    check_memory(100, 100)
    with pytest.raises(UserError, match=r"needs 3\.0 GiB and 1\.0 GiB are free: lower"):
        check_memory(3 * 2**30, 2**30)
