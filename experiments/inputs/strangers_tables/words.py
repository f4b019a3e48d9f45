"""What people write at the heads of their columns, in four languages: own lists, none of the importer's."""

from __future__ import annotations

LANGUAGES = ("en", "de", "es", "fr")
COMMAND = {
    "en": (
        *("Target", "Target position", "Commanded", "Commanded position", "Setpoint", "Nominal", "Nominal position"),
        *("Demand position", "Position", "Command", "cmd_pos", "Requested position", "Desired position", "target_pos"),
        *("Programmed position", "Stage position", "Set position", "Goal position", "Test position", "Axis command"),
    ),
    "de": (
        *("Sollposition", "Sollwert", "Soll", "Position", "Vorgabe", "Zielposition", "Sollweg", "Nennposition"),
        *("Pos. soll", "Anfahrposition", "Sollmaß", "Position soll", "Fahrbefehl", "Soll-Position"),
    ),
    "es": (
        *("Consigna", "Posición nominal", "Posición objetivo", "Objetivo", "Posición comandada"),
        *("Nominal", "Posición programada", "Posición teórica", "Posición ordenada", "Cota nominal"),
    ),
    "fr": (
        *("Consigne", "Position de consigne", "Position commandée", "Cible", "Position théorique"),
        *("Position visée", "Cote théorique", "Position nominale", "Position demandée", "Position cible"),
    ),
}
"""Of a commanded position."""
STEPS = {
    "en": ("Steps", "Step count", "Motor steps", "Microsteps", "steps", "n_steps", "Step", "Step position"),
    "de": ("Schritte", "Motorschritte", "Mikroschritte", "Schrittzahl", "Anzahl Schritte"),
    "es": ("Pasos", "Pasos del motor", "Número de pasos", "Micropasos"),
    "fr": ("Pas", "Pas moteur", "Nombre de pas", "Micropas"),
}
LENGTH_READING = {
    "en": (
        *("Measured", "Measured position", "Actual", "Actual position", "Reading", "Dial", "Dial gauge"),
        *("Dial reading", "Dial indicator", "DTI", "DRO", "Encoder", "Laser", "Interferometer", "Laser reading"),
        *("Gauge reading", "Micrometer", "Glass scale", "Linear scale", "LVDT", "Observed position", "meas_pos"),
    ),
    "de": (
        *("Istposition", "Istwert", "Ist", "Messwert", "Gemessen", "Messuhr", "Messtaster", "Taster", "Ablesung"),
        *("Anzeige", "Gemessene Position", "Glasmaßstab", "Laser", "Laserinterferometer", "Feinzeiger"),
        *("Messuhranzeige", "Ist-Position", "Pos. ist", "Position ist"),
    ),
    "es": (
        *("Medida", "Medición", "Posición medida", "Lectura", "Reloj comparador", "Comparador"),
        *("Valor medido", "Posición real", "Láser", "Regla óptica", "Posición leída"),
    ),
    "fr": (
        *("Mesure", "Position mesurée", "Valeur mesurée", "Lecture", "Comparateur", "Relevé"),
        *("Position réelle", "Mesuré", "Règle optique", "Palpeur", "Interféromètre"),
    ),
}
ANGLE_READING = {
    "en": (
        *("Measured angle", "Actual angle", "Angle", "Encoder", "Autocollimator", "Inclinometer", "Reading"),
        *("Encoder angle", "Measured", "Observed angle", "Theodolite", "Digital level"),
    ),
    "de": (
        *("Istwinkel", "Winkel gemessen", "Messwert", "Gemessener Winkel", "Autokollimator", "Neigungssensor"),
        *("Winkelmesser", "Drehgeber", "Theodolit", "Ablesung"),
    ),
    "es": ("Ángulo medido", "Ángulo real", "Lectura", "Inclinómetro", "Autocolimador", "Teodolito"),
    "fr": ("Angle mesuré", "Angle réel", "Lecture", "Codeur", "Inclinomètre", "Théodolite"),
}
ANGLE_COMMAND = {
    "en": ("Target angle", "Commanded angle", "Nominal angle", "Set angle", "Demand angle", "Target"),
    "de": ("Sollwinkel", "Winkel soll", "Zielwinkel", "Nennwinkel", "Vorgabewinkel"),
    "es": ("Ángulo nominal", "Ángulo comandado", "Ángulo objetivo", "Consigna de ángulo"),
    "fr": ("Angle de consigne", "Angle commandé", "Angle théorique", "Angle visé"),
}
DEVIATION = {
    "en": ("Deviation", "Error", "Position error", "Positioning error", "Dev.", "Positional deviation"),
    "de": ("Abweichung", "Fehler", "Positionsabweichung", "Abw.", "Positionsfehler", "Positionierabweichung"),
    "es": ("Desviación", "Error", "Error de posición", "Desviación de posición"),
    "fr": ("Écart", "Erreur", "Écart de position", "Erreur de position", "Ecart"),
}
DIRECTION = {
    "en": ("Direction", "Dir", "Approach", "Dir.", "Approach direction", "Travel direction"),
    "de": ("Richtung", "Anfahrrichtung", "Fahrtrichtung", "Anfahrt"),
    "es": ("Dirección", "Sentido", "Sentido de aproximación"),
    "fr": ("Direction", "Sens", "Sens d'approche"),
}
SIDES = {
    "en": (
        *(("forward", "backward"), ("fwd", "bwd"), ("fwd", "rev"), ("up", "down"), ("Forward", "Reverse")),
        *(
            ("positive", "negative"),
            ("pos", "neg"),
            ("increasing", "decreasing"),
            ("F", "B"),
            ("from below", "from above"),
        ),
    ),
    "de": (
        *(("vor", "zurück"), ("vorwärts", "rückwärts"), ("hin", "rück"), ("auf", "ab")),
        *(("steigend", "fallend"), ("positiv", "negativ"), ("Hinfahrt", "Rückfahrt"), ("von unten", "von oben")),
    ),
    "es": (
        ("desde abajo", "desde arriba"),
        ("ida", "vuelta"),
        ("avance", "retroceso"),
        ("subida", "bajada"),
        ("adelante", "atrás"),
    ),
    "fr": (("aller", "retour"), ("avant", "arrière"), ("montée", "descente"), ("croissant", "décroissant")),
    "all": (("+", "-"), ("+1", "-1"), ("↑", "↓"), ("→", "←"), ("1", "-1")),
}
"""Of commands that rise, and that fall."""
RUN_SIDES = {
    "en": (("Forward", "Backward"), ("Fwd", "Bwd"), ("Forward", "Reverse"), ("Up", "Down"), ("Out", "Return")),
    "de": (
        *(("Vor", "Zurück"), ("Vorwärts", "Rückwärts"), ("Hin", "Rück"), ("Auf", "Ab")),
        *(("Hinfahrt", "Rückfahrt"), ("Steigend", "Fallend")),
    ),
    "es": (("Ida", "Vuelta"), ("Avance", "Retroceso"), ("Subida", "Bajada")),
    "fr": (("Aller", "Retour"), ("Avant", "Arrière"), ("Montée", "Descente")),
    "all": (("+", "-"), ("↑", "↓"), ("→", "←")),
}
"""The same at the heads of runs side by side."""
TURNS = (("CW", "CCW"), ("CCW", "CW"), ("clockwise", "counterclockwise"), ("rechts", "links"))
"""Which of them is rising follows from the order alone."""
RUN = {
    "en": ("Run", "Set", "Trial", "Cycle", "Pass", "Test", "Series"),
    "de": ("Messung", "Lauf", "Reihe", "Messreihe", "Durchgang", "Zyklus"),
    "es": ("Serie", "Ciclo", "Ensayo", "Medida", "Pasada"),
    "fr": ("Essai", "Série", "Cycle", "Passage", "Mesure"),
}
STANDARD_U = {
    "en": ("u", "std. uncertainty", "standard uncertainty", "sigma", "sd"),
    "de": ("u", "Standardunsicherheit", "u (k=1)"),
    "es": ("u", "Incertidumbre típica", "incertidumbre estándar"),
    "fr": ("u", "Incertitude-type", "incertitude type"),
}
EXPANDED_U = {
    "en": ("U (k=2)", "U95", "2 sd", "2 sigma", "2\u03c3", "Expanded uncertainty (k=2)", "U(k=2)", "2 Std Devn"),
    "de": ("U (k=2)", "Unsicherheit U95", "Messunsicherheit (k=2)", "erweiterte Messunsicherheit (k=2)", "U95"),
    "es": ("U (k=2)", "Incertidumbre expandida (k=2)", "U95", "Incertidumbre U (k=2)"),
    "fr": ("U (k=2)", "Incertitude élargie (k=2)", "U95", "Incertitude (k=2)"),
}
"""Twice the standard uncertainty, or 1.96 times."""
NUMBER = {
    "en": ("No.", "#", "Index", "n", "Line", "Sample"),
    "de": ("Nr.", "lfd. Nr.", "Zeile", "Nr"),
    "es": ("Nº", "Núm.", "Línea"),
    "fr": ("N°", "No", "Ligne"),
}
TEMPERATURE = {
    "en": ("Temperature (°C)", "Temp [°C]", "Temp (C)", "Air temperature (°C)", "temp_degC", "T (°C)"),
    "de": ("Temperatur (°C)", "Temp. [°C]", "Lufttemperatur (°C)", "Temperatur in °C"),
    "es": ("Temperatura (°C)", "Temp. (°C)", "Temperatura [°C]"),
    "fr": ("Température (°C)", "Temp. (°C)", "Température [°C]"),
}
OTHER = {
    "en": (
        *("Humidity (%)", "RH (%)", "Motor current (A)", "Current [mA]", "Air pressure (hPa)", "Supply (V)"),
        *("Load (N)", "Feed rate (mm/min)", "Speed (mm/s)", "Torque (Nm)", "Vibration (mm/s)"),
    ),
    "de": (
        *("Luftfeuchte (%)", "rel. Feuchte [%]", "Motorstrom (A)", "Luftdruck (hPa)", "Spannung (V)"),
        *("Vorschub (mm/min)", "Geschwindigkeit (mm/s)", "Drehmoment (Nm)", "Last (N)"),
    ),
    "es": ("Humedad (%)", "Corriente (A)", "Presión (hPa)", "Velocidad (mm/s)", "Avance (mm/min)", "Carga (N)"),
    "fr": ("Humidité (%)", "Courant (A)", "Pression (hPa)", "Vitesse (mm/s)", "Avance (mm/min)", "Charge (N)"),
}
"""Numbers that are no part of an axis: they do not follow the commands."""
COMMENT = {
    "en": ("Comment", "Remarks", "Notes"),
    "de": ("Bemerkung", "Kommentar"),
    "es": ("Observaciones", "Comentario"),
    "fr": ("Remarque", "Commentaire"),
}
REMARKS = {
    "en": ("", "", "", "ok", "door opened", "re-zeroed lamp", "coolant off"),
    "de": ("", "", "", "i.O.", "Tür offen", "Lampe an"),
    "es": ("", "", "", "bien", "puerta abierta"),
    "fr": ("", "", "", "bon", "porte ouverte"),
}
STATUS = {
    "en": (("Status", "ok", "bad"), ("valid", "1", "0"), ("Quality", "good", "outlier"), ("OK?", "yes", "no")),
    "de": (("Status", "ok", "Ausreißer"), ("gültig", "ja", "nein"), ("Gültig", "1", "0")),
    "es": (("Estado", "ok", "malo"), ("válido", "sí", "no"), ("Válida", "1", "0")),
    "fr": (("Statut", "ok", "mauvais"), ("valide", "oui", "non"), ("Valide", "1", "0")),
}
"""Name, the word of readings that count, and of those that do not."""
HOMING = {
    "en": ("Homing", "Homing no.", "home", "Home"),
    "de": ("Referenzfahrt", "Referenzfahrt Nr.", "Homing"),
    "es": ("Homing", "Referenciado"),
    "fr": ("Homing", "Prise d'origine"),
}
CYCLE = {"en": ("Cycle", "Run", "run"), "de": ("Zyklus", "Lauf"), "es": ("Ciclo",), "fr": ("Cycle",)}
SECOND_SENSOR = {
    "en": ("Reference", "Encoder 2", "Sensor B", "Laser tracker", "Second encoder", "Channel 2", "Motor encoder"),
    "de": ("Referenz", "Drehgeber", "Sensor 2", "Kanal 2", "Motorgeber"),
    "es": ("Referencia", "Sensor 2", "Encoder del motor", "Canal 2"),
    "fr": ("Référence", "Capteur 2", "Codeur moteur", "Voie 2"),
}
CLOCK = {
    "en": ("Time", "Timestamp", "time", "Date/Time"),
    "de": ("Zeit", "Zeitstempel", "Datum/Uhrzeit"),
    "es": ("Hora", "Fecha/Hora", "Tiempo"),
    "fr": ("Heure", "Horodatage", "Date/Heure"),
}
SECONDS = {
    "en": ("t (s)", "Time (s)", "time_s", "Elapsed time [s]"),
    "de": ("Zeit (s)", "t [s]", "Zeit in s"),
    "es": ("Tiempo (s)", "t (s)"),
    "fr": ("Temps (s)", "t [s]"),
}
PREAMBLE = {
    "en": (
        "Serial no.: 20417",
        "Operator: J. Smith",
        "Machine: mill, X axis",
        "Company: Example Ltd",
        "Test report 12",
    ),
    "de": (
        "Seriennummer: 20417",
        "Prüfer: M. Müller",
        "Maschine: Fräse, X-Achse",
        "Protokoll Nr. 12",
        "Verfahrweg (mm): 300",
    ),
    "es": (
        "Número de serie: 20417",
        "Operador: J. Pérez",
        "Máquina: fresadora, eje X",
        "Informe 12",
        "Recorrido (mm): 300",
    ),
    "fr": (
        "Numéro de série : 20417",
        "Opérateur : J. Dupont",
        "Machine : fraiseuse, axe X",
        "Rapport 12",
        "Course (mm) : 300",
    ),
}
DATE = {"en": "Date: 2026-03-12", "de": "Datum: 12.03.2026", "es": "Fecha: 12/03/2026", "fr": "Date : 12/03/2026"}
PAN = {
    "en": (("Pan (steps)", "Tilt (steps)"), ("pan_steps", "tilt_steps"), ("Az steps", "El steps"), ("M1 az", "M2 alt")),
    "de": (
        ("Schritte Az", "Schritte El"),
        ("Motor Az (Schritte)", "Motor El (Schritte)"),
        ("Pan Schritte", "Tilt Schritte"),
    ),
    "es": (("Pasos azimut", "Pasos elevación"), ("Pan (pasos)", "Tilt (pasos)")),
    "fr": (("Pas azimut", "Pas site"), ("Pas az", "Pas el"), ("Pan (pas)", "Tilt (pas)")),
}
"""Counters of a head."""
AZIMUTH = {
    "en": (
        ("Azimuth", "Elevation"),
        ("Az", "El"),
        ("Az", "Alt"),
        ("azimuth", "altitude"),
        ("Measured az", "Measured el"),
    ),
    "de": (("Azimut", "Elevation"), ("Azimut", "Höhe"), ("Az gemessen", "El gemessen")),
    "es": (("Azimut", "Elevación"), ("Azimut", "Altura"), ("Az medido", "El medido")),
    "fr": (("Azimut", "Élévation"), ("Azimut", "Site"), ("Azimut", "Hauteur")),
}
MOTOR = {
    "en": ("Motor angle", "Motor position", "Motor shaft angle", "Input shaft"),
    "de": ("Motorwinkel", "Motorstellung", "Antriebswinkel"),
    "es": ("Ángulo del motor", "Posición del motor"),
    "fr": ("Angle moteur", "Position du moteur"),
}
"""Commands before the gears."""
OUTPUT = {
    "en": ("Output angle", "Table angle", "Measured output angle"),
    "de": ("Abtriebswinkel", "Tischwinkel", "Gemessener Winkel"),
    "es": ("Ángulo de salida", "Ángulo medido"),
    "fr": ("Angle de sortie", "Angle mesuré"),
}
PAIRS = {
    "en": (
        *(("cmd", "fb"), ("PosCmd", "PosFbk"), ("x_ref", "x_meas"), ("Goal Position", "Present Position")),
        *(("Nominal", "Actual"), ("targetPos", "measuredPos"), ("DEMAND", "FEEDBACK"), ("desired", "measured")),
        *(("X nominal", "X actual"), ("commanded", "observed"), ("SET", "READ"), ("set point", "process value")),
        *(("Move to", "Caliper"), ("Destination", "Height gauge"), ("Ref. position", "Meas. position"), ("SP", "PV")),
    ),
    "de": (
        *(("X_soll", "X_ist"), ("Soll", "Ist"), ("Nennwert", "Istwert"), ("SOLL", "IST"), ("Führungsgröße", "Istwert")),
        *(
            ("Sollmaß", "Istmaß"),
            ("Zielwert", "Messschieber"),
            ("Sollstellung", "Iststellung"),
            ("Fahre auf", "Messuhr"),
        ),
    ),
    "es": (
        *(("nominal", "real"), ("Valor objetivo", "Valor medido"), ("Consigna", "Valor real"), ("Teórica", "Medida")),
        *(("Posición de destino", "Calibre"), ("Mando", "Lectura del reloj")),
    ),
    "fr": (
        *(("théorique", "réel"), ("Valeur cible", "Valeur lue"), ("Consigne", "Recopie"), ("Nominal", "Réel")),
        *(("Position de destination", "Pied à coulisse"), ("Commande", "Mesure"), ("Théorique", "Relevée")),
    ),
}
"""Names of command and reading that belong together."""
MEANS = {
    "en": ("Mean forward", "Mean backward", "Mean", "Std dev"),
    "de": ("Mittelwert vor", "Mittelwert zurück", "Mittelwert", "Standardabweichung"),
    "es": ("Media ida", "Media vuelta", "Media", "Desviación típica"),
    "fr": ("Moyenne aller", "Moyenne retour", "Moyenne", "Écart-type"),
}
"""Of a sheet of runs: both sides, all, scatter."""
FOOTER = {
    "en": ("Checked by: J. Smith", "Max. error: 0.034", "End of test"),
    "de": ("Geprüft: M. Müller", "Größte Abweichung: 0,034", "Ende der Messung"),
    "es": ("Revisado: J. Pérez", "Error máximo: 0,034", "Fin del ensayo"),
    "fr": ("Vérifié : J. Dupont", "Écart maximal : 0,034", "Fin de l'essai"),
}
"""Lines below a table."""
ENCODERS = (
    ("Encoder az", "Encoder el"),
    ("enc_pan", "enc_tilt"),
    ("Pan encoder", "Tilt encoder"),
    ("Enc Az", "Enc Alt"),
)
"""Of a head."""
