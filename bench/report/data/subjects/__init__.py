"""What single pages and their neighbours read of records: by the question that they answer."""
