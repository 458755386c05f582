"""What a parallel jaw can hold on an object: ridges, pairs of faces and edges, opposed points."""
