"""The documents: a file for each `weldscan-*/N`, with its model, its reading and its writing (docs/formats.md).

| document                        | module         |
|---------------------------------|----------------|
| weldscan-session/1, and a plan  | `session`, `part`, `frames`, `plan` |
| weldscan-scanner/2              | `scanner`      |
| weldscan-hand-eye/1             | `hand_eye`     |
| weldscan-shot/1                 | `shot`         |
| weldscan-calibration/1          | `capture`      |
| weldscan-response/1             | `response`     |
| weldscan-result/1, /2           | `result`       |
| weldscan-verification/1         | `verification` |
| weldscan-verification-history/1 | `history`      |
| weldscan-validation/1           | `validation`   |
| touch.csv                       | `touch`        |

`files` opens and writes all of them, `fields` says what they are made of and how a complaint reads, `images` are PNGs.
"""
