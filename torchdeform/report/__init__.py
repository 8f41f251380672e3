"""What a person looks at: the overview picture and the record of a registration."""
