"""Widths of areas whose widths are known."""

import pytest
import shapely

from fabricate.checks import slices


class TestAreas:
    bar = shapely.box(0, 0, 10, 0.3)
    block = shapely.box(0, 0, 10, 5)

    @pytest.mark.parametrize(
        ("limit", "tested"), [(2.0, 1.9), (1.0, 0.95), (0.4, 0.38), (0.3, 0.28), (0.08, 0.06), (0.04, 0.03)]
    )
    def test_what_is_rough_is_allowed_for(self, limit, tested):
        assert slices.tested_width(limit) == pytest.approx(tested)

    def test_a_bar_is_as_wide_as_it_is(self):
        (patch,) = slices.too_narrow(self.bar, 0.4)
        assert patch.area == pytest.approx(self.bar.area, rel=1e-3)
        assert slices.least_width(self.bar, slices.too_narrow(self.bar, 0.4), 0.4) == pytest.approx(0.3, abs=0.011)
        assert len(slices.too_narrow(self.bar, 0.31)) == 0
        assert len(slices.too_narrow(self.block, 4.9)) == 0
        assert slices.spare_width(self.block, 1.0) == pytest.approx(5, rel=0.03)

    def test_only_what_lies_within_counts(self):
        both = shapely.union(self.bar, shapely.box(0, 5, 10, 5.35))
        assert len(slices.too_narrow(both, 0.4)) == 2
        (patch,) = slices.too_narrow(both, 0.4, within=shapely.box(-1, 4, 20, 6))
        assert patch.bounds == pytest.approx((0, 5, 10, 5.35), abs=1e-3)
        assert slices.least_width(both, slices.too_narrow(both, 0.4), 0.4) == pytest.approx(0.3, abs=0.011)

    @pytest.mark.parametrize(("neck", "narrow"), [(0.7, False), (1.5, True)])
    def test_what_leads_far_from_something_wider_is_no_tip(self, neck, narrow):
        """A peg 0.3 wide on a block: the tip of it up to twice the least width long, a thin wall beyond."""
        peg = shapely.union(self.block, shapely.box(4, 5, 4.3, 5 + neck))
        assert bool(len(slices.too_narrow(peg, 0.4))) == narrow

    def test_a_bridge_between_two_blocks_is_no_tip(self):
        bridge = shapely.union_all([self.block, shapely.box(4, 5, 4.3, 5.5), shapely.box(0, 5.5, 10, 9)])
        assert len(slices.too_narrow(bridge, 0.4)) == 1

    @pytest.mark.parametrize(("slot", "closed"), [(1.9, True), (2.1, False)])
    def test_slots_up_to_two_millimetres_do_not_open_a_ring(self, slot, closed):
        ring = shapely.box(-10, -10, 10, 10).difference(shapely.box(-8, -8, 8, 8))
        cut = ring.difference(shapely.box(5, -slot / 2, 20, slot / 2))
        assert slices.enclosed(cut).contains(shapely.Point(0, 0)) == closed
