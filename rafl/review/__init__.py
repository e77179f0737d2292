"""The page on which a person looks at tracks and corrects them."""
