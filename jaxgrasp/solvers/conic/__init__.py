"""Programs with second-order cones, solved by a homogeneous embedding."""
