"""What is maximised: mutual information, edges, both fused, and the curvature at the optimum."""
