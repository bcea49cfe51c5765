"""The part of SAPIEN that is kept between episodes."""
