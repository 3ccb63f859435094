"""The structure of an arm for users and programs: facts with reasons, closed forms, and a numerical verification."""
