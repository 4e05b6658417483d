"""Pick and place: a camera that finds parts, and actions that grasp, carry and put them down."""
