"""Column maps of the real samples: what a user would write to read these exports."""

from __future__ import annotations

MAPS = {
    # Angles in rad stand where the contract has lengths: only their spectra are looked at.
    "fditools_two_inertia_bench/open/MultisineTypeA.mat": """
[columns]
time = "time"
delta_e_motor = "theta_mx"
delta_e_load = "theta_my"
current_a = "iq_adx"
[units]
time = 1e-6
delta_e_motor = 1.0
delta_e_load = 1.0
""",
    "dropbear_ds8/open/10steps_test0.txt.gz": """
[columns]
time_s = "3"
acc_low = "0"
acc_high = "1"
[units]
acc_low = 1.0
acc_high = 1.0
[csv]
skip_rows = 9
delimiter = "\\t"
header = false
""",
    "tdms_reader_samples/big_endian.tdms": """
[columns]
acc_amplitude_g = "Amplitude sweep"
acc_phase_g = "Phase sweep"
""",
    "tdms_reader_samples/raw1.tdms": """
[columns]
acc_first = "First  Channel"
[units]
acc_first = 9.80665
""",
    "uff58_samples/dataset_milestone_in_header.uff": """
[columns]
acc_sound = \
"M.REDON   [.../20EH0456 2017-12-06 Creteil Wet50C 14mm TorqueJLR 36V BIPO1/1 :1]"
[units]
acc_sound = 1.0
""",
}
_GUIDE = """
[columns]
time_s = "X.Data"
delta_e_motor_mm = "Y(1).Data"
delta_e_load_mm = "Y(2).Data"
[mat]
variable = "{name}"
"""
_SHAKE = """
[columns]
time = "SampleTimeFine"
acc_x_m_s2 = "Acc_X"
acc_y_m_s2 = "Acc_Y"
[units]
time = 1e-6
[csv]
skip_rows = 7
"""
_MICROPHONE = """
[columns]
acc_sound = "Mic 01.0Scalar"
[units]
acc_sound = 1.0
"""
MAPS |= {f"lsb250_linear_guide/open/{k}.mat": _GUIDE.format(name=k) for k in ("exp1", "exp2")}
MAPS |= {
    f"shake_3storey/open/{frame}_BonusEvent_{floor}.csv": _SHAKE
    for frame in ("Flexible", "Stiff")
    for floor in ("Gro", "1st", "2nd", "3rd")
}
MAPS |= {
    f"dropbear_ds8/open/10steps_test{k}.txt.gz": MAPS["dropbear_ds8/open/10steps_test0.txt.gz"]
    for k in (1, 2)
}
MAPS |= {f"uff58_samples/Sample_UFF58{kind}.uff": _MICROPHONE for kind in ("_ascii", "b_bin")}
