"""Operations are counted by formula, whatever the machine: products, attention, and what is drawn."""

import pytest
import tiny_arig_training
import torch
from torch.nn.functional import scaled_dot_product_attention

from sfms_robot.lab.bench.operation_count import OperationCount
from sfms_robot.lab.learning.dry_run import dry_run


def test_a_layer_costs_two_operations_a_weight_and_row_and_its_gradient_as_many_again():
    layer = torch.nn.Linear(10, 20)
    with OperationCount() as count:
        layer(torch.randn(5, 10)).sum().backward()
    assert count.matrix == 2 * 5 * 10 * 20 * 2
    assert count.drawn == 50


def test_attention_counts_on_a_processor_too():
    rows = torch.randn(2, 4, 16, 8)
    with OperationCount() as count:
        scaled_dot_product_attention(rows, rows, rows)
    assert count.matrix == 2 * (2 * 2 * 4 * 16 * 16 * 8)
    assert count.bytes >= rows.numel() * 4 * 4


@pytest.mark.parametrize(("most_frames", "pieces"), [(1200, 1), (48, 2), (1, 4)])
def test_a_step_costs_the_same_however_small_the_pieces_that_are_made_of_it(monkeypatch, most_frames, pieces):
    """But for what is done once a piece: scaling the loss, sums of gradients."""
    monkeypatch.setattr(dry_run, "MOST_FRAMES", most_frames)
    (found,) = dry_run.dry_run(tiny_arig_training.settings())["stages"]
    monkeypatch.undo()
    (whole,) = dry_run.dry_run(tiny_arig_training.settings())["stages"]
    assert (found["pieces"], found["batch"], found["steps"]) == (pieces, 4, 6)
    assert found["operations"] == pytest.approx(whole["operations"], rel=0.1)
    assert found["drawn"] == pytest.approx(whole["drawn"], rel=0.1)
