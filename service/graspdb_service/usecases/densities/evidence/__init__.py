"""What trials say against what was foretold: robots against simulation, grasps that held against geometry."""
