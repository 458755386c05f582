"""Pictures of objects and grippers, drawn by rays (Embree) on any processor: no display, no graphics card."""
