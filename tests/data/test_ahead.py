"""The next result is made while the last one is used: not earlier, nor in another order."""

import threading

import pytest

from torchrl_nerd.data.mappers import ahead


def test_results_come_in_order_and_every_item_once():
    assert list(ahead(lambda item: item * item, range(9))) == [n * n for n in range(9)]
    assert list(ahead(abs, [])) == []


def test_the_next_call_is_under_way_while_a_result_is_used():
    began = [threading.Event() for _ in range(6)]

    def draw(item: int) -> int:
        began[item].set()
        return item

    for item in ahead(draw, range(6)):
        assert began[min(item + 1, 5)].wait(10.0)
        assert not any(event.is_set() for event in began[item + 2 :])


def test_calls_do_not_overlap():
    alone = threading.Lock()

    def draw(item: int) -> int:
        assert alone.acquire(blocking=False)
        threading.Event().wait(0.01)
        alone.release()
        return item

    assert list(ahead(draw, range(6))) == list(range(6))


@pytest.mark.parametrize("kind", [ValueError, KeyboardInterrupt])
def test_what_a_call_raises_is_raised_in_its_place(kind):
    def draw(item: int) -> int:
        if item == 2:
            raise kind(f"got {item}")
        return item

    results = ahead(draw, range(5))
    assert [next(results), next(results)] == [0, 1]
    with pytest.raises(kind, match="got 2"):
        next(results)


def test_who_stops_early_leaves_no_thread():
    before = threading.active_count()
    results = ahead(abs, range(100))
    assert next(results) == 0
    results.close()
    assert threading.active_count() == before
