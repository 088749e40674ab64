"""What only training needs: losses, labels, the completion decoder, the loop, checkpoints."""
