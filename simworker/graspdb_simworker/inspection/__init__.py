"""What a person asks of the simulation: does it hold at a finer step, and what does a grasp look like?"""
