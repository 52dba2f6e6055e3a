"""Park brake adaptation: the estimator learns contact, curve and friction from motor current and angle alone."""
