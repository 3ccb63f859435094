# headers alone
