"""What a project is: its model, and how it is loaded, validated and split."""
