"""The structure said in words: facts, and the reasons for them."""
