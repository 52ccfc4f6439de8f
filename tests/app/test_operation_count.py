"""Operations are counted by formula, whatever the machine: products, attention, and what is drawn."""

import torch
from torch.nn.functional import scaled_dot_product_attention

from sfms_robot.app.operation_count import OperationCount


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
