"""An arm's structure as people and programs read it: facts with reasons, closed forms, and a numerical proof."""
