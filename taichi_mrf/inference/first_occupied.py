"""Messages and slaves of a factor that depends on the first occupied cell alone, in O(n).

A beam has cells 0 .. n-1; e_k is its energy if cell k is the first occupied one, e_n if none is. Others
tell the beam that occupied costs t_i more than free in cell i. With m(t) the least cost of a cell that is
left to itself, min(0, t), or -log(1 + e^-t) where costs are summed instead of minimised, a pass from the
origin outwards keeps

    ahead_0 = infinity      ahead_{i+1} = least(ahead_i + m(t_i), e_i + t_i)

the least cost of the cells before i if one of them is occupied, against all being free; and a pass inwards

    behind_n = e_n          behind_i = least(e_i + t_i - m(t_i), behind_{i+1} - m(t_i))

the least cost of the cells from i on if all before are free, against their being left to themselves. Then
what occupied costs more than free in cell i, as the beam sees it without the cell's own t_i (eqs. 17 and
20), is

    message_i = least(ahead_i, e_i) - least(ahead_i, behind_{i+1})

and min_x e(x) + sum_i t_i x_i = behind_0 + sum_i m(t_i) is the slave's value (eq. 23). Everything is
relative, so that no number is larger than the energies and the messages themselves: float32 loses nothing,
and integers (of 1 / UNITS) do not overflow. Minimising, the functions take either.
"""

from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import Template
from taichi_mrf.voxels.log_odds import softplus

NEVER = 1e9
"""Stands for the infinite cost of 'one of no cells is occupied'."""

NEGLIGIBLE = 17.0
"""e^-17 is lost beside 1 in float32."""


@ti.func
def least(a: Template, b: Template, soft: Template):
    """min(a, b), or -log(e^-a + e^-b) with ``soft``."""
    value = ti.min(a, b)
    if ti.static(soft):
        apart = ti.abs(a - b)
        if apart < NEGLIGIBLE:
            value -= softplus(-apart)
    return value


@ti.func
def left_alone(t: Template, soft: Template):
    """m(t): the least cost of a cell that no factor looks at."""
    value = ti.min(0, t)
    if ti.static(soft):
        value = -softplus(-t)
    return value


@ti.func
def next_ahead(ahead: Template, energy: Template, t: Template, soft: Template):
    """ahead_{i+1} from ahead_i, e_i and t_i."""
    return least(ahead + left_alone(t, soft), energy + t, soft)


@ti.func
def next_behind(behind: Template, energy: Template, t: Template, soft: Template):
    """behind_i from behind_{i+1}, e_i and t_i."""
    alone = left_alone(t, soft)
    return least(energy + (t - alone), behind - alone, soft)


@ti.func
def message(ahead: Template, energy: Template, behind: Template, soft: Template):
    """message_i from ahead_i, e_i and behind_{i+1}."""
    return least(ahead, energy, soft) - least(ahead, behind, soft)
