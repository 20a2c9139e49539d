"""What if: sites of a log executed afresh, with something changed, against those that stand as recorded."""
