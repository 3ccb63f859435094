"""Many runs at once, on one machine or a cluster: arms, presets, seeds and splits, and one report about all of them."""
