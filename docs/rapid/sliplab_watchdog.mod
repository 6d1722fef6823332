MODULE sliplab_watchdog
    ! Stops the arm when the computer that moves it has gone: crash, pulled cable, lost power.
    !
    ! Runs as a SEMISTATIC background task (sliplab_watchdog_sys.cfg) beside the motion task. Its
    ! signals are analog outputs (sliplab_watchdog_eio.cfg):
    !   sliplab_beat   written by the computer several times a second; any change is a beat
    !   sliplab_limit  written by the computer: seconds without a beat until the arm is stopped,
    !                  0: not watched. Set to 0 here when the arm has been stopped
    !   sliplab_echo   written here: the last beat that was seen
    !
    ! It stops the program of the motion tasks, and the arm on its path, as the stop button of the
    ! pendant does. It unlocks, restarts and moves nothing.

    CONST num cycle_s:=0.02;

    PROC main()
        VAR clock silence;
        VAR num beat:=-1;
        SetAO sliplab_limit,0;
        WHILE TRUE DO
            IF AOutput(sliplab_beat)<>beat OR AOutput(sliplab_limit)<=0 THEN
                beat:=AOutput(sliplab_beat);
                SetAO sliplab_echo,beat;
                ClkStop silence;
                ClkReset silence;
                ClkStart silence;
            ELSEIF ClkRead(silence)>AOutput(sliplab_limit) THEN
                SetAO sliplab_limit,0;
                SystemStopAction\Stop;
            ENDIF
            WaitTime cycle_s;
        ENDWHILE
    ENDPROC
ENDMODULE
