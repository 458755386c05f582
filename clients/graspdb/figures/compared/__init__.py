"""Figures of reports that compare: what one says with what another, or the world, says."""
