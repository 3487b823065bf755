"""What a pad is judged by: expected error, ambiguity, the published objective, and rules with their penalties."""
