import struct

import pytest

from lerobot_uca.robots.ur5e.sim.protocol import INPUT_TYPES, OUTPUT_TYPES, Recipe, packet


def test_a_packet_unpacks_to_what_was_packed():
    recipe = Recipe.parse(b"timestamp,actual_q,robot_mode,joint_mode,actual_digital_input_bits,", OUTPUT_TYPES)
    values = {
        "timestamp": 1.5,
        "actual_q": (0.1, 0.2, 0.3, 0.4, 0.5, 0.6),
        "robot_mode": -1,
        "joint_mode": (253,) * 6,
        "actual_digital_input_bits": 2**63,
    }
    payload = recipe.pack(values)
    assert len(payload) == 8 + 6 * 8 + 4 + 6 * 4 + 8
    assert recipe.unpack(payload) == values
    assert packet(85, payload)[:3] == struct.pack(">HB", len(payload) + 3, 85)


def test_variables_without_a_value_are_zero():
    recipe = Recipe.parse(b"actual_q,runtime_state", OUTPUT_TYPES)
    assert recipe.unpack(recipe.pack({})) == {"actual_q": (0.0,) * 6, "runtime_state": 0}


def test_an_unknown_variable_is_answered_as_such():
    recipe = Recipe.parse(b"timestamp,warp_factor,", OUTPUT_TYPES)
    assert recipe.reply(1) == b"\x01DOUBLE,NOT_FOUND"
    assert not recipe.is_known


def test_a_packet_of_another_length_is_refused():
    recipe = Recipe.parse(b"input_int_register_0,input_double_register_0", INPUT_TYPES)
    with pytest.raises(struct.error):
        recipe.unpack(b"\x00" * 11)
