"""An open benchmark: recordings of rigs whose cause is known, and what a tool says of them. It knows palpd by its API only."""
