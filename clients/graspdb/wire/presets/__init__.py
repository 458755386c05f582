"""What every GraspDB brings along."""
