//! Checks against closed forms.
