"""Many runs: suites on one machine or several, what they say together, and searches."""
