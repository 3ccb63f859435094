"""Every preset trained on the same data with the same care, judged side by side, next to published figures."""
