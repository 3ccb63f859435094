"""The derived structure of an arm for users: facts as sentences with reasons, closed forms, numerical verification."""
