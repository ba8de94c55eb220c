CREATE TABLE runs (
    name BLOB PRIMARY KEY, recording TEXT NOT NULL, beside TEXT NOT NULL, started_s REAL NOT NULL,
    kind TEXT NOT NULL, dry INTEGER NOT NULL, verdict TEXT NOT NULL, reason TEXT NOT NULL, duration_s REAL, ticks INTEGER, missed INTEGER,
    peak_force_N REAL, cut_short INTEGER, robot_host TEXT, sensor_serial TEXT, config_sha256 TEXT, model_sha256 TEXT,
    machine_stiffness_N_per_m REAL, facts TEXT NOT NULL,
    tags TEXT NOT NULL DEFAULT '', note TEXT NOT NULL DEFAULT '', remarks TEXT NOT NULL DEFAULT ''
);
CREATE INDEX runs_by_time ON runs (started_s);
CREATE TABLE moduli (
    run BLOB NOT NULL, place INTEGER NOT NULL, site TEXT NOT NULL, static_Pa REAL, static_low_Pa REAL, static_high_Pa REAL,
    dynamic_Pa REAL, corrected_Pa REAL, corrected_low_Pa REAL, corrected_high_Pa REAL, hertz_misfit INTEGER NOT NULL,
    PRIMARY KEY (run, place)
) WITHOUT ROWID;
CREATE INDEX moduli_by_site ON moduli (site);
CREATE TABLE effects (
    run BLOB NOT NULL, site TEXT NOT NULL, effect TEXT NOT NULL, parameter TEXT NOT NULL, value REAL, low REAL, high REAL, probability REAL
);
CREATE INDEX effects_by_run ON effects (run);
