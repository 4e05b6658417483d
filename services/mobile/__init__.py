"""Actions and drivers of the rover on the chessboard track: camera on one node, wheels and
reflector sensor on another."""
