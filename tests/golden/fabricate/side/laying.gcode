; padforge: the fibres of a pad, laid by a needle
; 3 fibres in 2 layers, 0.37 m; 0.6 minutes of laying
; the pad lies turned over, left to right, with its tracks up, on a flat plate
; seen from above: x to the right, against the pad's, y away from you; fibre 1 starts at the near edge
; z is 0 where the needle touches the upper face; it goes down to -0.900 mm
; needle of at most 0.37 mm, pad 6 mm thick
; the pad's middle is at X110 Y110; set zero of z by G92 Z0 (Marlin), G10 L20 P1 Z0 (GRBL)
G21
G90
M0 (needle over the pad, zero of z is set)
G1 Z5 F1800
G1 X116 Y67.5 Z5 F1800
G1 Z-0.9 F600
M0 (fibre 2, vertical 1: fasten its end under the needle)
G1 Y120.2
G1 Y120.5 F480
G1 X116.015 Y120.675
G1 X116.034 Y120.76
G1 X116.094 Y120.922
G1 X116.18 Y121.073
G1 X116.293 Y121.207
G1 X116.427 Y121.32
G1 X116.578 Y121.406
G1 X116.74 Y121.466
G1 X116.825 Y121.485
G1 X117 Y121.5
G1 X117.3
G1 X131.907 Y121.496 F540
G1 X132.207 F480
G1 X132.294 Y121.485
G1 X132.461 Y121.44
G1 X132.618 Y121.366
G1 X132.761 Y121.267
G1 X132.826 Y121.207
G1 X132.939 Y121.073
G1 X133.025 Y120.922
G1 X133.085 Y120.76
G1 X133.115 Y120.588
G1 X133.119 Y120.5
G1 Y120.2
G1 Y67.5 F600
M0 (fibre 2, vertical 1: cut it at the needle)
G1 Z5 F1800
G1 X104
G1 Z-0.9 F600
M0 (fibre 3, vertical 2: fasten its end under the needle)
G1 Y120.2
G1 Y120.5 F480
G1 X103.985 Y120.675
G1 X103.966 Y120.76
G1 X103.906 Y120.922
G1 X103.82 Y121.073
G1 X103.707 Y121.207
G1 X103.573 Y121.32
G1 X103.422 Y121.406
G1 X103.26 Y121.466
G1 X103.175 Y121.485
G1 X103 Y121.5
G1 X102.7
G1 X88.093 Y121.496 F540
G1 X87.793 F480
G1 X87.706 Y121.485
G1 X87.539 Y121.44
G1 X87.382 Y121.366
G1 X87.239 Y121.267
G1 X87.174 Y121.207
G1 X87.061 Y121.073
G1 X86.975 Y120.922
G1 X86.915 Y120.76
G1 X86.885 Y120.588
G1 X86.881 Y120.5
G1 Y120.2
G1 Y67.5 F600
M0 (fibre 3, vertical 2: cut it at the needle)
G1 Z5 F1800
M0 (layer 1 of 2, 1.2 mm deep: seal it and let it cure)
G1 X129.5
G1 Z-0.1 F600
M0 (fibre 1, horizontal 1: fasten its end under the needle)
G1 Y108.7
G1 Y109 F480
G1 X129.485 Y109.175
G1 X129.466 Y109.26
G1 X129.406 Y109.422
G1 X129.32 Y109.573
G1 X129.207 Y109.707
G1 X129.073 Y109.82
G1 X128.922 Y109.906
G1 X128.76 Y109.966
G1 X128.675 Y109.985
G1 X128.5 Y110
G1 X128.2
G1 X91.8 F600
G1 X91.5 F480
G1 X91.325 Y109.985
G1 X91.24 Y109.966
G1 X91.078 Y109.906
G1 X90.927 Y109.82
G1 X90.858 Y109.767
G1 X90.733 Y109.642
G1 X90.634 Y109.499
G1 X90.56 Y109.342
G1 X90.515 Y109.175
G1 X90.5 Y109
G1 Y108.7
G1 Y67.5 F600
M0 (fibre 1, horizontal 1: cut it at the needle)
G1 Z5 F1800
M0 (layer 2 of 2, 0.4 mm deep: seal it and let it cure)
