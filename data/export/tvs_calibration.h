{% macro listed(values) %}{% for value in values %}{{ number(value) }}{{ ", " if not loop.last }}{% endfor %}{% endmacro %}
/* Laser positioner calibration, written by tvsbayes (steps-for --export header). C99, no allocation.
{% if origin %}
 * Campaign: {{ plain(origin.campaign) }}, measured {{ origin.measured or "on an unrecorded date" }}; exported {{ origin.exported }} by tvsbayes {{ origin.tvsbayes }}.
 * SHA-256 of the same calibration as JSON, without its origin: {{ sha256 }}.
{% else %}
 * Of a calibration without a campaign.
{% endif %}
 * Expected error ({{ plain(calibration.estimator) }}, 95 %) at pan {{ error.pan_steps }}, tilt {{ error.tilt_steps }} steps: azimuth {{ "%.3f deg, elevation %.3f deg; at 1 m %.2f mm." | format(error.u95_azimuth_deg, error.u95_elevation_deg, error.u95_at_1_m_mm | max) }}
{% for line in promise %}
 * {{ line }}
{% endfor %}
 * Frame T: origin mid-baseline, x depth, y along the baseline towards the positioner, z up; mm.
 * Counters are absolute steps after homing; a side is +1 (reached left or up) or -1 (right or down).
 * tvs_beam and tvs_locate compute the beam and a point from counters; tvs_steps_for_point and tvs_steps_for_direction
 * compute counters, with intermediate counters to visit first: the move from there takes up the play. Limits of the
 * counters may be defined before this file is included: TVS_LIMIT_PAN_LOW, TVS_LIMIT_PAN_HIGH, and likewise TILT.
 * Errors of the gears (transmission error, change of play) are interpolated in tables over the counters. Outside the
 * counters observed in the campaign (see tvs_extrapolated) they are unknown within tvs_error_u_deg.
 *
 *     const double wanted[3] = {800.0, 100.0, 20.0};
 *     struct tvs_steps go;
 *     if (tvs_steps_for_point(wanted, 1, 1, &go) > 0) {
 *         move(go.via_pan_steps, go.via_tilt_steps);
 *         move(go.pan_steps, go.tilt_steps);
 *     }
 */
#ifndef TVS_CALIBRATION_H
#define TVS_CALIBRATION_H

#include <math.h>

{% for name, value in calibration.estimates.items() %}
#define TVS_{{ name | replace(".", "_") | upper }} {{ number(value) }}
{% endfor %}
{% for axis in gears %}
#define TVS_PERIOD_{{ axis | upper }}_DEG {{ number(calibration.period_deg.get(axis, 0.0)) }}
#define TVS_OVERSHOOT_{{ axis | upper }}_STEPS {{ calibration.overshoot_steps[axis] }}
{% endfor %}
#define TVS_AZIMUTH_CONVENTION {{ calibration.azimuth | int }}
{% for axis, (low, high) in calibration.seen_steps.items() %}
{% set upper, table = axis | upper, gears[axis] %}
#define TVS_SEEN_{{ upper }}_LOW {{ number(low) }}
#define TVS_SEEN_{{ upper }}_HIGH {{ number(high) }}
#define TVS_TABLE_{{ upper }}_SIZE {{ table.steps | length }}
#define TVS_TABLE_{{ upper }}_FIRST {{ number(table.steps[0]) }}
#define TVS_TABLE_{{ upper }}_LAST {{ number(table.steps[-1]) }}
#define TVS_BEYOND_{{ upper }}_ERROR_U_DEG {{ number(table.beyond_u_transmission_error_deg) }}
#define TVS_BEYOND_{{ upper }}_PLAY_U_DEG {{ number(table.beyond_u_play_variation_deg) }}
{% for name, field in tables.items() %}
static const double TVS_{{ name }}_{{ upper }}_DEG[] = {
{% for row in table[field] | batch(4) %}
    {{ listed(row) }}{{ "," if not loop.last else "};" }}
{% endfor %}
{% endfor %}
{% endfor %}

#define TVS_RAD 0.017453292519943295

static inline double tvs_error_deg(double angle_deg, double period_deg, double c1, double s1, double c2, double s2)
{
    double phase = 360.0 * TVS_RAD * angle_deg / period_deg;
    return c1 * cos(phase) + s1 * sin(phase) + c2 * cos(2 * phase) + s2 * sin(2 * phase);
}

static inline double tvs_output_deg(double steps, int side, double ratio, double backlash, double period_deg, double c1,
                             double s1, double c2, double s2)
{
    double angle = ratio * steps;
    if (period_deg > 0 && period_deg < 360.0)
        angle += tvs_error_deg(angle, period_deg, c1, s1, c2, s2);
    angle -= 0.5 * side * backlash;
    if (period_deg >= 360.0)
        angle += tvs_error_deg(angle, period_deg, c1, s1, c2, s2);
    return angle;
}

/* Value at a counter, by cubic interpolation in a table of regular counters; `beyond` outside the table. */
static inline double tvs_table(const double *table, int size, double first, double last, double steps, double beyond)
{
    double found = 0, at = last > first ? (steps - first) * (size - 1) / (last - first) : 0;
    int begin = 0;
    if (last > first && (steps < first || steps > last))
        return beyond;
    while (begin < size - 4 && at >= begin + 2)
        begin++;
    for (int k = 0; k < 4; k++) {
        double share = table[begin + k];
        for (int other = 0; other < 4; other++)
            if (other != k)
                share *= (at - begin - other) / (k - other);
        found += share;
    }
    return found;
}

/* Whether these counters are outside those of the campaign's looks. */
static inline int tvs_extrapolated(double pan_steps, double tilt_steps)
{
    return !(pan_steps >= TVS_SEEN_PAN_LOW && pan_steps <= TVS_SEEN_PAN_HIGH && tilt_steps >= TVS_SEEN_TILT_LOW &&
             tilt_steps <= TVS_SEEN_TILT_HIGH);
}

/* Contribution of gear errors to the mirror angle of pan (0) or tilt (1) at a counter, degrees. */
static inline double tvs_gear_deg(int tilt, double steps, int side)
{
    if (tilt)
        return tvs_table(TVS_ERROR_TILT_DEG, TVS_TABLE_TILT_SIZE, TVS_TABLE_TILT_FIRST, TVS_TABLE_TILT_LAST, steps, 0) -
               0.5 * side *
                   tvs_table(TVS_PLAY_TILT_DEG, TVS_TABLE_TILT_SIZE, TVS_TABLE_TILT_FIRST, TVS_TABLE_TILT_LAST, steps, 0);
    return tvs_table(TVS_ERROR_PAN_DEG, TVS_TABLE_PAN_SIZE, TVS_TABLE_PAN_FIRST, TVS_TABLE_PAN_LAST, steps, 0) -
           0.5 * side *
               tvs_table(TVS_PLAY_PAN_DEG, TVS_TABLE_PAN_SIZE, TVS_TABLE_PAN_FIRST, TVS_TABLE_PAN_LAST, steps, 0);
}

/* Combined standard uncertainty of the transmission error and half the change of play at a counter, degrees. */
static inline double tvs_error_u_deg(int tilt, double steps)
{
    double error = tilt ? tvs_table(TVS_ERROR_U_TILT_DEG, TVS_TABLE_TILT_SIZE, TVS_TABLE_TILT_FIRST,
                                    TVS_TABLE_TILT_LAST, steps, TVS_BEYOND_TILT_ERROR_U_DEG)
                        : tvs_table(TVS_ERROR_U_PAN_DEG, TVS_TABLE_PAN_SIZE, TVS_TABLE_PAN_FIRST, TVS_TABLE_PAN_LAST,
                                    steps, TVS_BEYOND_PAN_ERROR_U_DEG);
    double play = tilt ? tvs_table(TVS_PLAY_U_TILT_DEG, TVS_TABLE_TILT_SIZE, TVS_TABLE_TILT_FIRST, TVS_TABLE_TILT_LAST,
                                   steps, TVS_BEYOND_TILT_PLAY_U_DEG)
                       : tvs_table(TVS_PLAY_U_PAN_DEG, TVS_TABLE_PAN_SIZE, TVS_TABLE_PAN_FIRST, TVS_TABLE_PAN_LAST,
                                   steps, TVS_BEYOND_PAN_PLAY_U_DEG);
    return sqrt(error * error + 0.25 * play * play);
}

/* Mirror angles in degrees. */
static inline double tvs_pan_deg(double steps, int side)
{
    return tvs_gear_deg(0, steps, side) + tvs_output_deg(steps, side, TVS_DEGREES_PER_STEP_PAN, TVS_BACKLASH_DEG_PAN, TVS_PERIOD_PAN_DEG,
                          TVS_HARMONIC_DEG_PAN_1_COS, TVS_HARMONIC_DEG_PAN_1_SIN, TVS_HARMONIC_DEG_PAN_2_COS,
                          TVS_HARMONIC_DEG_PAN_2_SIN);
}

static inline double tvs_tilt_deg(double steps, int side)
{
    return TVS_TILT_ZERO_DEG + tvs_gear_deg(1, steps, side) + tvs_output_deg(steps, side, TVS_DEGREES_PER_STEP_TILT, TVS_BACKLASH_DEG_TILT,
                                              TVS_PERIOD_TILT_DEG, TVS_HARMONIC_DEG_TILT_1_COS,
                                              TVS_HARMONIC_DEG_TILT_1_SIN, TVS_HARMONIC_DEG_TILT_2_COS,
                                              TVS_HARMONIC_DEG_TILT_2_SIN);
}

static inline void tvs_reflect(double p[3], double d[3], const double at[3], const double n[3])
{
    double along = d[0] * n[0] + d[1] * n[1] + d[2] * n[2];
    double reach = ((at[0] - p[0]) * n[0] + (at[1] - p[1]) * n[1] + (at[2] - p[2]) * n[2]) / along;
    for (int i = 0; i < 3; i++) {
        p[i] += reach * d[i];
        d[i] -= 2 * along * n[i];
    }
}

static inline void tvs_turn(double v[3], double angle)
{
    double x = cos(angle) * v[0] - sin(angle) * v[1];
    v[1] = sin(angle) * v[0] + cos(angle) * v[1];
    v[0] = x;
}

/* The beam at mirror angles in degrees: origin in mm and unit direction, frame T. */
static inline void tvs_mirror_beam(double pan_deg, double tilt_deg, double origin[3], double direction[3])
{
    double psi = TVS_RAD * pan_deg, beta = TVS_RAD * tilt_deg;
    double tx = tan(TVS_RAD * TVS_LASER_TILT_DEG_X), ty = tan(TVS_RAD * TVS_LASER_TILT_DEG_Y);
    double length = sqrt(1 + tx * tx + ty * ty);
    double m1 = TVS_RAD * (45 + TVS_MIRROR1_ERROR_DEG), m2 = TVS_RAD * (45 + TVS_MIRROR2_ERROR_DEG);
    double skew = TVS_RAD * TVS_TILT_AXIS_SKEW_DEG;
    double p[3] = {TVS_LASER_OFFSET_MM_X, TVS_LASER_OFFSET_MM_Y, 0}, d[3] = {tx / length, ty / length, -1 / length};
    const double zero[3] = {0, 0, 0}, n1[3] = {0, -sin(m1), cos(m1)};
    const double centre[3] = {TVS_TILT_AXIS_OFFSET_MM_X, -TVS_MIRROR_OFFSET_MM, TVS_TILT_AXIS_OFFSET_MM_Z};
    const double n2[3] = {sin(m2) * cos(beta), cos(m2) * cos(skew) - sin(m2) * sin(beta) * sin(skew),
                          cos(m2) * sin(skew) + sin(m2) * sin(beta) * cos(skew)};
    double turn = psi + TVS_RAD * (TVS_PAN_ZERO_EMISSION_DEG - 90);
    tvs_turn(p, -psi);
    tvs_turn(d, -psi);
    tvs_reflect(p, d, zero, n1);
    tvs_reflect(p, d, centre, n2);
    tvs_turn(p, turn);
    tvs_turn(d, turn);
    p[1] += 0.5 * TVS_BASELINE_MM;
    for (int i = 0; i < 3; i++) {
        origin[i] = p[i];
        direction[i] = d[i];
    }
}

/* The beam at counters reached from the given sides: origin in mm and unit direction, frame T. */
static inline void tvs_beam(double pan_steps, double tilt_steps, int pan_side, int tilt_side, double origin[3],
                            double direction[3])
{
    tvs_mirror_beam(tvs_pan_deg(pan_steps, pan_side), tvs_tilt_deg(tilt_steps, tilt_side), origin, direction);
}

/* The point where the beam meets the surface of the aperture's reading, frame T, mm. Returns 0 where they do not meet,
 * or meet behind the scanner; 1 where they meet; 2 where they meet at counters outside those of the campaign. */
static inline int tvs_locate(double pan_steps, double tilt_steps, int pan_side, int tilt_side, double aperture_deg,
                      double xyz[3])
{
    double o[3], d[3], reach;
    double b = TVS_RAD * (aperture_deg - TVS_APERTURE_ZERO_DEG), sb = sin(b), cb = cos(b);
    tvs_beam(pan_steps, tilt_steps, pan_side, tilt_side, o, d);
    double y = o[1] + 0.5 * TVS_BASELINE_MM;
    if (TVS_AZIMUTH_CONVENTION) {
        reach = (y * sb - o[0] * cb) / (d[0] * cb - d[1] * sb);
        if ((o[0] + reach * d[0]) * sb + (y + reach * d[1]) * cb < 0)
            return 0;
    } else {
        double mx = y * d[2] - o[2] * d[1], my = o[2] * d[0] - o[0] * d[2], mz = o[0] * d[1] - y * d[0];
        double inside = (mx * mx + mz * mz) * sb * sb - my * my * cb * cb;
        if (inside < 0)
            return 0;
        reach = (y * y - cb * cb * (o[0] * o[0] + y * y + o[2] * o[2])) /
                (cb * sqrt(inside) - (y * d[1] - cb * cb * (o[0] * d[0] + y * d[1] + o[2] * d[2])));
        /* The other nappe of the cone belongs to the reading 180 deg - B. */
        if ((y + reach * d[1]) * cb < -1e-12 * fabs(reach * cb))
            return 0;
    }
    if (!(reach > 0) || isinf(reach))
        return 0;
    if (!(o[0] + reach * d[0] > 0))
        return 0;
    for (int i = 0; i < 3; i++)
        xyz[i] = o[i] + reach * d[i];
    return tvs_extrapolated(pan_steps, tilt_steps) ? 2 : 1;
}

/* Reading of the aperture for a point of frame T, degrees. */
static inline double tvs_reading_deg(const double xyz[3])
{
    double lateral = TVS_AZIMUTH_CONVENTION ? xyz[0] : hypot(xyz[0], xyz[2]);
    return atan2(lateral, xyz[1] + 0.5 * TVS_BASELINE_MM) / TVS_RAD + TVS_APERTURE_ZERO_DEG;
}

/* Counters to move to, in whole steps. */
struct tvs_steps {
    long via_pan_steps, via_tilt_steps; /* visited first: the move from there takes up the play */
    long pan_steps, tilt_steps;         /* visited second */
    int pan_side, tilt_side;            /* sides on which these are reached: +1 left or up, -1 right or down */
    int extrapolated;                   /* whether they are outside those of the campaign's looks */
};

#define TVS_NO_ANGLES 0
#define TVS_OUTSIDE_LIMITS (-1)
#define TVS_UNLIMITED 1e9
#ifndef TVS_LIMIT_PAN_LOW
#define TVS_LIMIT_PAN_LOW (-TVS_UNLIMITED)
#endif
#ifndef TVS_LIMIT_PAN_HIGH
#define TVS_LIMIT_PAN_HIGH TVS_UNLIMITED
#endif
#ifndef TVS_LIMIT_TILT_LOW
#define TVS_LIMIT_TILT_LOW (-TVS_UNLIMITED)
#endif
#ifndef TVS_LIMIT_TILT_HIGH
#define TVS_LIMIT_TILT_HIGH TVS_UNLIMITED
#endif

/* Mirror angles (pan, tilt) that send the beam through a point (mm, frame T), or for a null pointer along azimuth and
 * elevation, degrees; returns whether such angles exist. */
static inline int tvs_aim(const double *point, double azimuth_deg, double elevation_deg, double mirror_deg[2])
{
    int ahead = point ? isfinite(point[0]) && isfinite(point[1]) && isfinite(point[2]) && point[0] > 0
                      : isfinite(azimuth_deg) && isfinite(elevation_deg) && fabs(azimuth_deg) < 90;
    mirror_deg[0] = mirror_deg[1] = 0;
    for (int k = 0; ahead && k < 40; k++) {
        double o[3], d[3], azimuth, elevation;
        tvs_mirror_beam(mirror_deg[0], mirror_deg[1], o, d);
        if (point) {
            double x = point[0] - o[0], y = point[1] - o[1], z = point[2] - o[2];
            azimuth_deg = atan2(y, x) / TVS_RAD;
            elevation_deg = atan2(z, hypot(x, y)) / TVS_RAD;
        }
        azimuth = remainder(azimuth_deg - atan2(d[1], d[0]) / TVS_RAD, 360.0);
        elevation = elevation_deg - atan2(d[2], hypot(d[0], d[1])) / TVS_RAD;
        if (fmax(fabs(azimuth), fabs(elevation)) < 1e-11 / TVS_RAD)
            return 1;
        mirror_deg[0] += azimuth;
        mirror_deg[1] += elevation;
        if (fabs(mirror_deg[1]) > 90)
            return 0;
    }
    return 0;
}

/* The integer counter of pan (0) or tilt (1) whose mirror angle, reached from a side, is nearest to the wanted one. */
static inline double tvs_counter(int tilt, double mirror_deg, int side)
{
    double steps = 0;
    for (int k = 0; k < 40; k++) {
        double at = tilt ? tvs_tilt_deg(steps, side) : tvs_pan_deg(steps, side);
        double change = (mirror_deg - at) / (tilt ? TVS_DEGREES_PER_STEP_TILT : TVS_DEGREES_PER_STEP_PAN);
        steps += change;
        if (fabs(change) < 1e-9)
            break;
    }
    return rint(steps);
}

/* Counters for a mirror angle reached from a side; 0 means left or up unless limits forbid it. Returns success. */
static inline int tvs_arrive(int tilt, double mirror_deg, int *side, long *steps, long *via)
{
    double low = tilt ? TVS_LIMIT_TILT_LOW : TVS_LIMIT_PAN_LOW, high = tilt ? TVS_LIMIT_TILT_HIGH : TVS_LIMIT_PAN_HIGH;
    double ratio = tilt ? TVS_DEGREES_PER_STEP_TILT : TVS_DEGREES_PER_STEP_PAN;
    double overshoot = (ratio > 0 ? 1 : -1) * (tilt ? TVS_OVERSHOOT_TILT_STEPS : TVS_OVERSHOOT_PAN_STEPS);
    int first = *side ? *side : 1, last = *side ? *side : -1;
    for (int way = first;; way = last) {
        double there = tvs_counter(tilt, mirror_deg, way), before = there - way * overshoot;
        if (low <= there && there <= high && low <= before && before <= high) {
            *side = way;
            *steps = (long)there;
            *via = (long)before;
            return 1;
        }
        if (way == last)
            return 0;
    }
}

static inline int tvs_steps_to(const double *point, double azimuth_deg, double elevation_deg, int pan_side,
                               int tilt_side, struct tvs_steps *found)
{
    double mirror_deg[2];
    found->pan_side = pan_side;
    found->tilt_side = tilt_side;
    if (!tvs_aim(point, azimuth_deg, elevation_deg, mirror_deg))
        return TVS_NO_ANGLES;
    if (!tvs_arrive(0, mirror_deg[0], &found->pan_side, &found->pan_steps, &found->via_pan_steps) ||
        !tvs_arrive(1, mirror_deg[1], &found->tilt_side, &found->tilt_steps, &found->via_tilt_steps))
        return TVS_OUTSIDE_LIMITS;
    found->extrapolated = tvs_extrapolated((double)found->pan_steps, (double)found->tilt_steps);
    return found->extrapolated ? 2 : 1;
}

/* Counters that send the beam to a point of frame T, mm. Sides are +1, -1, or 0: left and up unless limits forbid it.
 * Returns 1, or 2 where the counters are outside those of the campaign's looks, TVS_NO_ANGLES without suitable mirror
 * angles, or TVS_OUTSIDE_LIMITS; `found` is complete only after 1 and 2. */
static inline int tvs_steps_for_point(const double xyz[3], int pan_side, int tilt_side, struct tvs_steps *found)
{
    return tvs_steps_to(xyz, 0, 0, pan_side, tilt_side, found);
}

/* As tvs_steps_for_point, for a direction: azimuth atan2(y, x) and elevation above the horizontal, degrees. */
static inline int tvs_steps_for_direction(double azimuth_deg, double elevation_deg, int pan_side, int tilt_side,
                                          struct tvs_steps *found)
{
    return tvs_steps_to((const double *)0, azimuth_deg, elevation_deg, pan_side, tilt_side, found);
}

#endif
